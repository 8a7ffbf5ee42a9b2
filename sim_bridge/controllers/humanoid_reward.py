"""Rewards of the humanoid while it learns to walk and to get up."""

import numpy as np

from sim_bridge.controllers.humanoid import com_velocity, head_height, uprightness
from sim_bridge.controllers.posture import FALLEN_HEAD_M
from sim_bridge.simulator import Array

_SCALE = 0.4


def walking_reward(observations: Array, facing: Array, directions: Array, actions: Array) -> Array:
    """Reward of a control step, shape (n,): walk along the direction at 1.5 m/s, head up.

    Standing still is worth a fifth of walking: with more, nobody learns to walk.

    Args:
        observations: OGBench's after the step, shape (n, 69).
        facing: Cosine of the angle between the torso's x axis and the direction, shape (n,).
        directions: Unit vectors (x, y), shape (n, 2).
        actions: Shape (n, 21).
    """
    head = head_height(observations)
    height = _relative_height(head)
    gate = ((head - FALLEN_HEAD_M) / 0.35).clip(0, 1)
    upright = (1 + uprightness(observations)) / 2
    velocity = com_velocity(observations)
    speed = (velocity * directions).sum(axis=-1)
    lateral = np.abs(velocity[:, 0] * directions[:, 1] - velocity[:, 1] * directions[:, 0])
    standing = 0.1 * height + 0.15 * height**2 * upright
    walking = 1.5 * (speed / 1.5).clip(-0.5, 1) - 0.6 * (speed - 1.6).clip(0)
    walking += 0.1 * facing - 0.1 * lateral.clip(max=2)
    return _SCALE * (standing + gate * walking - 0.05 * np.square(actions).mean(axis=-1))


def standing_reward(observations: Array, actions: Array) -> Array:
    """Reward of a control step, shape (n,): get the head up, above an upright torso.

    Args:
        observations: OGBench's after the step, shape (n, 69).
        actions: Shape (n, 21).
    """
    height = _relative_height(head_height(observations))
    upright = (1 + uprightness(observations)) / 2
    standing = 0.4 * height + 0.6 * height**2 * upright
    return _SCALE * (standing - 0.05 * np.square(actions).mean(axis=-1))


def _relative_height(head: Array) -> Array:
    """From 0 for a head on the floor to 1 for that of one who stands."""
    return ((head - 0.1) / 1.25).clip(0, 1)
