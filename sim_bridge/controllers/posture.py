"""Whether a robot stands or has fallen, from its generalised positions."""

import numpy as np
from numpy.typing import NDArray

FALLEN_COSINE = 0.25
"""A robot has fallen when its torso leans further than this cosine from the vertical."""


def uprightness(qpos: np.ndarray) -> NDArray[np.float64]:
    """Cosine of the angle between the torso's axis and the vertical: 1 upright, -1 on its back.

    Args:
        qpos: Shape (..., nq) with nq >= 7, beginning with the free joint of the torso: x, y, z
            and the quaternion (w, x, y, z).
    """
    x, y = qpos[..., 4].astype(np.float64), qpos[..., 5].astype(np.float64)
    return 1 - 2 * (x**2 + y**2)


def count_falls(qpos: np.ndarray) -> int:
    """How often a robot fell in one episode, by its positions of shape (T, nq) in order.

    A robot without a free joint, such as the point, cannot fall.
    """
    if qpos.shape[-1] < 7:
        return 0
    fallen = uprightness(qpos) < FALLEN_COSINE
    return int(fallen[0]) + int((fallen[1:] & ~fallen[:-1]).sum())
