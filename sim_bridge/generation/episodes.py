"""Recording of one episode of offline data."""

from dataclasses import dataclass

import numpy as np

from sim_bridge.controllers import DirectionFollower
from sim_bridge.controllers.posture import has_fallen
from sim_bridge.generation.behaviours import BEHAVIOURS, Kind
from sim_bridge.simulator import Simulator

CUT_S = 1.0
"""What is left out before a fall, seconds."""


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

    @property
    def terminals(self) -> np.ndarray:
        """True at the last row, shape (T + 1,), bool."""
        return np.arange(len(self.actions)) == len(self.actions) - 1


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
    cut_falls: bool = False,
) -> Episode:
    """Run the behaviour policy for one episode of `num_rows` rows.

    At every row the follower is given the behaviour's direction; Gaussian noise of standard
    deviation `noise` is added to its action, and the sum is clipped to [-1, 1]. With `to_goal` it
    walks to the goals themselves, not to the centres of their cells. With
    `cut_falls` a fall ends the episode, and its last second is left out; an episode of which
    nothing remains is recorded again.

    Source: OGBench, `data_gen_scripts/generate_locomaze.py`. Deviation: the action of the last
    row is recorded but not simulated, since no row would hold its outcome.
    """
    behaviour = BEHAVIOURS[kind](simulator.maze, rng, to_goal)
    observation = simulator.reset_free(seed=int(rng.integers(2**32)), start_xy=behaviour.start_xy)
    behaviour.begin(simulator)

    observations, actions, qpos, qvel = [], [], [], []
    kept = num_rows
    for row in range(num_rows):
        qpos.append(simulator.qpos)
        action = follower.act(observation, behaviour.direction(simulator, row), qpos[-1])
        action = np.clip(action + rng.normal(0.0, noise, action.shape), -1.0, 1.0)
        observations.append(observation)
        actions.append(action)
        qvel.append(simulator.qvel)
        if row == num_rows - 1:
            break
        result = simulator.step(action)
        if cut_falls and has_fallen(simulator.qpos):
            kept = row + 1 - round(CUT_S / simulator.spec.control_period_s)
            break
        observation = result.observation
        if result.success:
            behaviour.at_goal(simulator)
    if kept < 2:
        return record_episode(simulator, follower, kind, num_rows, noise, rng, to_goal, True)
    return Episode(
        observations=np.array(observations[:kept], dtype=np.float32),
        actions=np.array(actions[:kept], dtype=np.float32),
        qpos=np.array(qpos[:kept], dtype=np.float32),
        qvel=np.array(qvel[:kept], dtype=np.float32),
        goals_reached=behaviour.goals_reached,
    )
