"""Health of a node and the statistics behind it."""

from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

WINDOW_S = 5.0
MINUTE_S = 60.0


class Level(IntEnum):
    """Severity, as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Health:
    """Health of a node: a level, the reason, and values by name with their units."""

    level: Level
    message: str
    values: dict[str, str] = field(default_factory=dict)


class Samples:
    """Most recent values of a quantity."""

    def __init__(self, size: int = 1000) -> None:
        """Keep the last `size` values."""
        self._values: deque[float] = deque(maxlen=size)

    def add(self, value: float) -> None:
        """Record a value."""
        self._values.append(value)

    def percentile(self, percent: float) -> float:
        """The percentile of the values; 0 when there are none."""
        return float(np.percentile(list(self._values), percent)) if self._values else 0.0

    def last(self) -> float:
        """The newest value; 0 when there are none."""
        return self._values[-1] if self._values else 0.0


class Rate:
    """Rate of an event over the last five seconds."""

    def __init__(self) -> None:
        """Start without events."""
        self._times_s: deque[float] = deque()
        self.total = 0

    def add(self, now_s: float) -> None:
        """Record an event at `now_s`, seconds of a monotonic clock."""
        self._times_s.append(now_s)
        self.total += 1
        self._forget(now_s)

    def per_second(self, now_s: float) -> float:
        """The rate in hertz."""
        self._forget(now_s)
        return len(self._times_s) / WINDOW_S

    def _forget(self, now_s: float) -> None:
        while self._times_s and now_s - self._times_s[0] > WINDOW_S:
            self._times_s.popleft()


class Deadlines:
    """Counts control periods without an action."""

    def __init__(self) -> None:
        """Start without deadlines; the first action sets the first one."""
        self._last_s: float | None = None
        self._last_answered: tuple[int, int] | None = None
        self._missed: deque[tuple[float, int]] = deque()
        self.total = 0

    def met(self, now_s: float, period_s: float) -> None:
        """Record an action; whole periods since the previous one, rounded, were missed."""
        if self._last_s is not None:
            self._miss(now_s, int((now_s - self._last_s) / period_s + 0.5) - 1)
        self._last_s = now_s

    def answered(self, now_s: float, episode_id: int, step: int) -> None:
        """Record the action for a state; the steps of the episode in between were missed.

        For simulated time, which advances in steps: the deadline of a state is the next one.
        """
        if self._last_answered is not None and self._last_answered[0] == episode_id:
            self._miss(now_s, step - self._last_answered[1] - 1)
        self._last_answered = (episode_id, step)

    def pause(self) -> None:
        """Suspend the deadlines until the next action."""
        self._last_s = self._last_answered = None

    def in_last_minute(self, now_s: float) -> int:
        """The number of periods missed in the last minute."""
        while self._missed and now_s - self._missed[0][0] > MINUTE_S:
            self._missed.popleft()
        return sum(missed for _, missed in self._missed)

    def _miss(self, now_s: float, count: int) -> None:
        if count > 0:
            self._missed.append((now_s, count))
            self.total += count


class Faults:
    """Recent faults, kept for a while so that short ones are reported too."""

    def __init__(self) -> None:
        """Start without faults."""
        self.counts: dict[str, int] = {}
        self._newest = ('', float('-inf'))

    def note(self, kind: str, reason: str, now_s: float) -> None:
        """Record a fault of a kind, such as `malformed_states`, with its reason."""
        self.counts[kind] = self.counts.get(kind, 0) + 1
        self._newest = (reason, now_s)

    def recent(self, now_s: float, memory_s: float = 1.0) -> str:
        """The reason of the newest fault; empty when it is older than `memory_s`."""
        reason, time_s = self._newest
        return reason if now_s - time_s <= memory_s else ''
