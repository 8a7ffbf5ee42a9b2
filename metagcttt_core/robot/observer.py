"""Observations from messages, the same for recorded and live ones."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from metagcttt_core.robot.contract import Contract
from metagcttt_core.robot.errors import MessageError
from metagcttt_core.robot.numbers import observe
from metagcttt_core.robot.topics import ObservedTopic


@dataclass(frozen=True)
class _Reading:
    values: NDArray[np.float64]
    stamp_ns: int
    received_ns: int


class Observer:
    """Keeps the newest good message of every observed topic and joins them to observations.

    A message is measured against the one before: it has to be newer and within reach. Once a topic
    has had no good message for `timeout_s` there is nothing to measure against, so that a robot
    that was carried away is observed again after that time. One whose clock was set back, as a
    simulation that starts again does, is observed again at once, and never by what came before.

    Attributes:
        segment: Counts unbroken stretches of observations from 1; the last one's number.
        late: Why there was no observation at the last `sample`; empty when there was one.
    """

    def __init__(self, contract: Contract) -> None:
        """Start without messages.

        Args:
            contract: The contract to evaluate.
        """
        self._topics = {topic.topic: topic for topic in contract.observe}
        self._period_ns = contract.period_ns
        self._newest: dict[str, _Reading] = {}
        self._is_broken = True
        self.segment = 0
        self.late = 'nothing was observed yet'

    def take(self, topic: str, message: Any, received_ns: int) -> str:
        """Take in a message; returns why it is refused, or nothing.

        Args:
            topic: Its topic, as the contract names it.
            message: Any object with the fields of the message.
            received_ns: Time of its reception, nanoseconds of the clock that `sample` goes by.
        """
        observed = self._topics[topic]
        before = self._newest.get(topic)
        silent_ns = received_ns - before.received_ns if before else 0
        is_stale = silent_ns > _nanoseconds(observed.timeout_s) and observed.align != 'hold'
        if is_stale or silent_ns < 0:  # less than none: the clock was set back
            before = None
            self._is_broken = True
        try:
            stamp_ns = _stamp(observed, message, received_ns)
            parts = [observe(value, message) for value in observed.values]
            if before:
                if stamp_ns < before.stamp_ns:
                    seconds = (before.stamp_ns - stamp_ns) / 1e9
                    raise MessageError(f'stamped {seconds:g} s before the message before it')
                _check_reach(observed, before, np.concatenate(parts), stamp_ns)
        except MessageError as error:
            return f'{topic}: {error}'
        self._newest[topic] = _Reading(np.concatenate(parts), stamp_ns, received_ns)
        return ''

    def begin_again(self) -> None:
        """Forget what was observed before the clock went back, but for what is held."""
        kept = self._newest.items()
        self._newest = {name: each for name, each in kept if self._topics[name].align == 'hold'}
        self._is_broken = True

    def sample(self, now_ns: int) -> NDArray[np.float64] | None:
        """The observation at `now_ns`, shape (obs_dim,); none while a topic is late."""
        self.late = self._lateness(now_ns)
        if self.late:
            self._is_broken = True
            return None
        self.segment += self._is_broken
        self._is_broken = False
        return np.concatenate([self._newest[topic].values for topic in self._topics])

    def _lateness(self, now_ns: int) -> str:
        for name, topic in self._topics.items():
            newest = self._newest.get(name)
            if newest is None:
                return f'{name}: no usable message yet'
            if topic.align == 'hold':
                continue
            is_drop = topic.align == 'drop'
            limit_ns = self._period_ns if is_drop else _nanoseconds(topic.timeout_s)
            age_ns = now_ns - newest.stamp_ns
            if age_ns > limit_ns:
                return f'{name}: the newest usable message is {age_ns / 1e9:.2f} s old'
            if age_ns < -_nanoseconds(topic.timeout_s):
                return f'{name}: the clock is {-age_ns / 1e9:.2f} s before the newest message'
        return ''


def stamp_of(message: Any) -> int:
    """The time in a message's header, nanoseconds.

    Raises:
        MessageError: If it has no header.
    """
    try:
        stamp = message.header.stamp
    except AttributeError as error:
        raise MessageError('it has no header') from error
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _stamp(topic: ObservedTopic, message: Any, received_ns: int) -> int:
    """The time of a message by the contract, its frame checked as well."""
    if topic.frame_id is not None:
        stamp_of(message)  # has a header
        if message.header.frame_id != topic.frame_id:
            raise MessageError(f'frame {message.header.frame_id!r}, not {topic.frame_id!r}')
    if topic.stamp == 'receive':
        return received_ns
    stamp_ns = stamp_of(message)
    behind_ns = received_ns - stamp_ns
    may_be_old = topic.align == 'hold' and behind_ns > 0
    if abs(behind_ns) > _nanoseconds(topic.timeout_s) and not may_be_old:
        side = 'before' if behind_ns > 0 else 'after'
        raise MessageError(
            f'stamped {abs(behind_ns) / 1e9:g} s {side} its reception: late, or another clock'
        )
    return stamp_ns


def _check_reach(
    topic: ObservedTopic, before: _Reading, values: NDArray[np.float64], stamp_ns: int
) -> None:
    """Refuse values that cannot have changed so fast.

    A change over less than a hundredth of the time-out counts as one over that time: stamps of
    messages in a burst are as good as equal.
    """
    seconds = max((stamp_ns - before.stamp_ns) / 1e9, 0.01 * topic.timeout_s)
    start = 0
    for value in topic.values:
        stop = start + len(value.columns)
        change = np.abs(values[start:stop] - before.values[start:stop])
        if value.max_rate is not None and change.max() > value.max_rate * seconds:
            name = value.columns[int(change.argmax())]
            raise MessageError(
                f'{name} jumps by {change.max():g} within {seconds:g} s, '
                f'up to {value.max_rate:g} per second is credible'
            )
        start = stop


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)
