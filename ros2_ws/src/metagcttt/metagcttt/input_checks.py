"""Checks of incoming messages: vectors, the order of states, the number of senders."""

import numpy as np
from numpy.typing import NDArray

RESTART_STATES = 3
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


class StateOrder:
    """Refuses states older than the newest one, unless their source has restarted.

    A restarted simulator counts from 1 again. Its states differ from stray ones in that they
    follow one another: the third in a row is accepted.
    """

    def __init__(self) -> None:
        """Accept any first state."""
        self._newest: tuple[int, int] | None = None
        self._older: tuple[int, int] | None = None
        self._num_older = 0

    def refusal(self, episode_id: int, step: int) -> str:
        """The reason why a state is out of order; empty when it is accepted, as repeats are."""
        number = (episode_id, step)
        if self._newest is None or number >= self._newest:
            return self._accept(number)
        follows = self._older is not None and number > self._older
        self._num_older = self._num_older + 1 if follows else 1
        self._older = number
        if self._num_older >= RESTART_STATES:
            return self._accept(number)
        newest_episode, newest_step = self._newest
        return (
            f'state {step} of episode {episode_id} came after state {newest_step} of episode '
            f'{newest_episode}'
        )

    def _accept(self, number: tuple[int, int]) -> str:
        self._newest, self._older, self._num_older = number, None, 0
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
