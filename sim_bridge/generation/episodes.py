"""Recording of one episode of offline data."""

from dataclasses import dataclass

import numpy as np

from sim_bridge.controllers import DirectionFollower
from sim_bridge.generation.behaviours import BEHAVIOURS, Kind
from sim_bridge.simulator import Simulator


@dataclass(frozen=True)
class Episode:
    """A recorded episode of T transitions in T + 1 rows; the last row's action is not taken.

    Attributes:
        observations: Shape (T + 1, obs_dim), float32.
        actions: Shape (T + 1, act_dim), float32.
        qpos: Generalised positions at each row, shape (T + 1, nq), float32.
        qvel: Generalised velocities at each row, shape (T + 1, nv), float32.
        goals_reached: Number of goals reached so far.
    """

    observations: np.ndarray
    actions: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    goals_reached: int


def episode_generator(seed: int, validation: bool, index: int) -> np.random.Generator:
    """Random generator of one episode.

    It depends on its arguments alone, so an episode is the same whichever process records it and
    however many others are recorded.
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(int(validation), index))
    return np.random.default_rng(sequence)


def record_episode(
    simulator: Simulator,
    follower: DirectionFollower,
    kind: Kind,
    num_rows: int,
    noise: float,
    rng: np.random.Generator,
    to_goal: bool = False,
) -> Episode:
    """Run the behaviour policy for one episode of `num_rows` rows.

    At every row the follower is given the behaviour's direction; Gaussian noise of standard
    deviation `noise` is added to its action, and the sum is clipped to [-1, 1]. With `to_goal` it
    walks to the goals themselves, not to the centres of their cells.

    Source: OGBench, `data_gen_scripts/generate_locomaze.py`. Deviation: the action of the last
    row is recorded but not simulated, since no row would hold its outcome.
    """
    behaviour = BEHAVIOURS[kind](simulator.maze, rng, to_goal)
    observation = simulator.reset_free(seed=int(rng.integers(2**32)), start_xy=behaviour.start_xy)
    behaviour.begin(simulator)

    observations, actions, qpos, qvel = [], [], [], []
    for row in range(num_rows):
        action = follower.act(observation, behaviour.direction(simulator, row))
        action = np.clip(action + rng.normal(0.0, noise, action.shape), -1.0, 1.0)
        observations.append(observation)
        actions.append(action)
        qpos.append(simulator.qpos)
        qvel.append(simulator.qvel)
        if row == num_rows - 1:
            break
        result = simulator.step(action)
        observation = result.observation
        if result.success:
            behaviour.at_goal(simulator)
    return Episode(
        observations=np.array(observations, dtype=np.float32),
        actions=np.array(actions, dtype=np.float32),
        qpos=np.array(qpos, dtype=np.float32),
        qvel=np.array(qvel, dtype=np.float32),
        goals_reached=behaviour.goals_reached,
    )
