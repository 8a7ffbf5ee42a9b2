"""Checks of incoming messages: vectors and the number of senders."""

import numpy as np
from numpy.typing import NDArray

SENDER_TIMEOUT_S = 1.0


def vector_fault(name: str, values: NDArray[np.float64], size: int) -> str:
    """The reason why `values` is not a vector of `size` finite numbers; empty when it is.

    Policies compute in single precision, so a number counts as finite when it is finite there.
    """
    if values.shape != (size,):
        return f'{name} has {values.size} values, {size} are needed'
    with np.errstate(over='ignore'):
        finite = np.isfinite(values.astype(np.float32)).all()
    if not finite:
        return f'{name} is not finite: {values.tolist()}'
    return ''


class Senders:
    """Counts the senders on a topic that is meant for one, by the number each has drawn."""

    def __init__(self) -> None:
        """Start with no sender."""
        self._seen_s: dict[int, float] = {}

    def saw(self, instance: int, now_s: float) -> None:
        """Record a message from a sender at `now_s`, seconds of a monotonic clock."""
        self._seen_s[instance] = now_s

    def count(self, now_s: float) -> int:
        """The number of senders within the last second."""
        self._seen_s = {
            instance: time_s
            for instance, time_s in self._seen_s.items()
            if now_s - time_s <= SENDER_TIMEOUT_S
        }
        return len(self._seen_s)
