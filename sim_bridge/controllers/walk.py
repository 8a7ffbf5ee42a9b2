"""Walks of a learned controller on an open floor, to see how well it follows directions."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_bridge.controllers.learned import LearnedFollower
from sim_bridge.controllers.posture import count_falls
from sim_bridge.opengl import choose_opengl_library


@dataclass(frozen=True)
class Walk:
    """One walk along one direction.

    Attributes:
        direction: Unit vector (x, y).
        path: Positions (x, y) from the first to the last, shape (T + 1, 2), metres.
        falls: How often the robot fell.
        period_s: Seconds per control step.
    """

    direction: np.ndarray
    path: np.ndarray
    falls: int
    period_s: float

    @property
    def distance_m(self) -> float:
        """Metres along the direction."""
        return float((self.path[-1] - self.path[0]) @ self.direction)

    @property
    def drift_m(self) -> float:
        """Metres to the left of the direction."""
        x, y = self.direction
        return float((self.path[-1] - self.path[0]) @ (-y, x))

    @property
    def speed(self) -> float:
        """Mean speed along the direction, metres per second."""
        return self.distance_m / (self.period_s * (len(self.path) - 1))


def walk_along(
    follower: LearnedFollower, direction: np.ndarray, duration_s: float, seed: int
) -> Walk:
    """Walk along a fixed direction from a random start pose; a fall does not end the walk."""
    choose_opengl_library()
    import gymnasium
    import ogbench.online_locomotion  # registers the environments  # noqa: F401

    environment: Any = gymnasium.make(
        f'online-{follower.robot}-v0', disable_env_checker=True
    ).unwrapped
    state, _ = environment.reset(seed=seed)
    qpos = [environment.data.qpos.copy()]
    for _ in range(round(duration_s / environment.dt)):
        # The controller leaves out x and y, which this environment does not tell.
        observation = np.concatenate([qpos[-1][:2], state])
        state, *_ = environment.step(follower.act(observation, direction))
        qpos.append(environment.data.qpos.copy())
    environment.close()
    positions = np.array(qpos)
    return Walk(direction, positions[:, :2], count_falls(positions), environment.dt)
