"""Posture of a robot, standing or fallen, from its generalised positions."""

import numpy as np
from numpy.typing import NDArray

FALLEN_COSINE = 0.25
"""A robot has fallen when its torso leans further than this cosine from the vertical."""
FALLEN_HEAD_M = 0.9
"""A humanoid has fallen when its head is lower; when it stands, that is at 1.4 to 1.5 m."""
_HUMANOID_NQ = 28
_NECK_M = 0.19
"""From the humanoid's torso up to its head, which has no joint of its own."""


def uprightness(qpos: np.ndarray) -> NDArray[np.float64]:
    """Cosine of the angle between the torso's axis and the vertical: 1 upright, -1 on its back.

    Args:
        qpos: Shape (..., nq) with nq >= 7, beginning with the free joint of the torso: x, y, z
            and the quaternion (w, x, y, z).
    """
    x, y = qpos[..., 4].astype(np.float64), qpos[..., 5].astype(np.float64)
    return 1 - 2 * (x**2 + y**2)


def has_fallen(qpos: np.ndarray) -> NDArray[np.bool_]:
    """True where a robot leans too far or, a humanoid, has its head too low, shape (...).

    A robot without a free joint, such as the point, cannot fall.
    """
    if qpos.shape[-1] < 7:
        return np.zeros(qpos.shape[:-1], bool)
    if qpos.shape[-1] == _HUMANOID_NQ:
        return qpos[..., 2] + _NECK_M * uprightness(qpos) < FALLEN_HEAD_M
    return uprightness(qpos) < FALLEN_COSINE


def count_falls(qpos: np.ndarray) -> int:
    """Number of falls in one episode, given generalised positions of shape (T, nq)."""
    fallen = has_fallen(qpos)
    return int(fallen[0]) + int((fallen[1:] & ~fallen[:-1]).sum())
