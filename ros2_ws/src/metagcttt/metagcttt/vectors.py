"""What makes a vector of numbers usable. No ROS in here."""

import numpy as np
from numpy.typing import NDArray


def vector_fault(name: str, values: NDArray[np.float64], size: int) -> str:
    """Why `values` is not a vector of `size` finite numbers; empty when it is.

    Policies compute in single precision, so a number counts as finite when it is finite there.
    """
    if values.shape != (size,):
        return f'{name} has {values.size} values, {size} are needed'
    with np.errstate(over='ignore'):
        finite = np.isfinite(values.astype(np.float32)).all()
    if not finite:
        return f'{name} is not finite: {values.tolist()}'
    return ''
