"""A humanoid that gets up when it has fallen: two policies, switched by the height of the head."""

import hashlib

import numpy as np

from sim_bridge.controllers.humanoid import head_height
from sim_bridge.controllers.humanoid_get_up import STANDING_HEAD_M
from sim_bridge.controllers.learned import LearnedFollower
from sim_bridge.controllers.posture import FALLEN_HEAD_M
from sim_bridge.simulator import Array

STEADY_STEPS = 20
"""Control steps in a row that it has to stand before it walks on: half a second."""


class RisingHumanoid:
    """Walks along a direction; fallen, it gets up first.

    It has to see every step of an episode: the second policy acts from the step on at which the
    head is lower than `FALLEN_HEAD_M`, until it was above `STANDING_HEAD_M` for `STEADY_STEPS`.
    """

    def __init__(self, walker: LearnedFollower, riser: LearnedFollower) -> None:
        """Take the policy that walks and the one that gets up."""
        self.walker = walker
        self.riser = riser
        self._wait = 0

    @property
    def sha256(self) -> str:
        """Hash of the weights of both."""
        return hashlib.sha256(f'{self.walker.sha256}{self.riser.sha256}'.encode()).hexdigest()

    def act(self, observation: Array, direction: Array, qpos: Array) -> Array:
        """Action for an observation of shape (69,) that gets up or moves along `direction`."""
        head = head_height(observation)
        if head < FALLEN_HEAD_M or (self._wait and head < STANDING_HEAD_M):
            self._wait = STEADY_STEPS
        elif self._wait:
            self._wait -= 1
        if self._wait:
            return self.riser.act(observation, np.zeros(2), qpos)
        return self.walker.act(observation, direction, qpos)
