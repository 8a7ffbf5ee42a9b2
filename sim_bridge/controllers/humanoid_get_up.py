"""Where a humanoid learns to get up: dropped in random poses and, at first, lifted."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_bridge.controllers.humanoid import head_height, policy_inputs
from sim_bridge.controllers.humanoid_crowd import (
    observe,
    physics_states,
    set_physics_states,
)
from sim_bridge.controllers.humanoid_ground import FRAME_SKIP, GroundStep
from sim_bridge.controllers.humanoid_reward import standing_reward
from sim_bridge.mazes.ogbench import open_floor
from sim_bridge.simulator import Array

EPISODE_STEPS = 300
RISE_STEPS = 200
"""Control steps after which a humanoid shall stand: 5 s."""
STANDING_HEAD_M = 1.25
"""A humanoid stands when its head is higher; the head of one with straight legs is at 1.49 m."""
_LIFTED_HEAD_M = 1.0, 1.3
"""The lift is whole below the first height of the head and gone above the second."""
_TORSO = 1


@dataclass(frozen=True, slots=True)
class GetUpCourse:
    """The conditions of training to get up.

    Attributes:
        floors: Humanoids, each on an open floor.
        lift: Upward force on the torso at the beginning, as a share of the weight.
        fade: What a humanoid that stands after 5 s takes from the lift of everyone; one that does
            not adds as much, up to `lift`.
    """

    floors: int
    lift: float = 0.8
    fade: float = 0.0005

    def ground(self, rng: np.random.Generator) -> 'GetUpGround':
        """The humanoids, dropped."""
        return GetUpGround(self, rng)


class GetUpGround:
    """n humanoids, dropped as OGBench drops them every 7.5 s, whatever they have reached.

    Attributes:
        inputs: What the policy sees now, shape (n, 67); the direction is zero.
        lift: Upward force on each torso, as a share of the weight.
    """

    def __init__(self, course: GetUpCourse, rng: np.random.Generator) -> None:
        """Load the physics and drop everyone; the episodes end one after the other."""
        self.course = course
        self.count = course.floors
        self.lift = course.lift
        self._envs = [open_floor('humanoid') for _ in range(self.count)]
        model = self._envs[0].model
        self._weight_n = -float(model.body_mass.sum() * model.opt.gravity[2])
        self._stood = np.zeros(self.count, bool)
        self._steps = rng.integers(EPISODE_STEPS, size=self.count)
        for env in self._envs:
            _drop(env, rng)
        self.inputs = self._look()[0]

    def step(self, actions: Array, rng: np.random.Generator) -> GroundStep:
        """Apply actions of shape (n, 21), each number within -1 to 1."""
        low, high = _LIFTED_HEAD_M
        for env, action in zip(self._envs, actions, strict=True):
            share = np.clip((high - head_height(env.get_ob())) / (high - low), 0, 1)
            env.data.xfrc_applied[_TORSO, 2] = share * self.lift * self._weight_n
            env.do_simulation(action, FRAME_SKIP)
        self._steps += 1
        next_inputs, observations = self._look()
        heads = head_height(observations)
        due = self._steps == RISE_STEPS
        self._stood[due] = heads[due] > STANDING_HEAD_M
        change = self.course.fade * (due.sum() - 2 * self._stood[due].sum())
        self.lift = float(np.clip(self.lift + change, 0, self.course.lift))
        cut = self._steps >= EPISODE_STEPS
        for index in np.flatnonzero(cut):
            _drop(self._envs[index], rng)
        self._steps[cut] = 0
        self.inputs = self._look()[0] if cut.any() else next_inputs
        return GroundStep(
            next_inputs,
            rewards=standing_reward(observations, actions),
            fallen=np.zeros(self.count, bool),
            cut=cut,
            figures={'lift': self.lift, 'stood_after_5_s': self._stood.mean()},
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """State of the training for a resumed run, by name."""
        return {
            'physics': physics_states(self._envs),
            'steps': self._steps,
            'stood': self._stood,
            'lift': np.array(self.lift),
        }

    def load_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what `arrays` gave."""
        set_physics_states(self._envs, arrays['physics'])
        self._steps[...], self._stood[...] = arrays['steps'], arrays['stood']
        self.lift = float(arrays['lift'])
        self.inputs = self._look()[0]

    def _look(self) -> tuple[Array, Array]:
        """The inputs of the policy, and the observations they come from."""
        observations, quaternions = observe(self._envs)
        directions = np.zeros((self.count, 2))
        return policy_inputs(observations, quaternions, directions), observations


def _drop(env: Any, rng: np.random.Generator) -> None:
    env.reset(seed=int(rng.integers(2**32)))
