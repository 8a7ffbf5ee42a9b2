"""Pacing of a simulation against real time."""

import math

BURST = 2
"""Most steps at once to catch up; few, so that new actions arrive in between."""


class Pacer:
    """Counts steps against deadlines fixed from the start, so that delays do not accumulate.

    A delay is caught up gradually. Steps beyond `max_lag_s` are dropped and counted: the machine
    is too slow for the requested pace.
    """

    def __init__(self, period_s: float, now_s: float, max_lag_s: float = 0.5) -> None:
        """Start counting.

        Args:
            period_s: Time between two steps, seconds of the clock of `now_s`.
            now_s: The time now; the first step is due one period later.
            max_lag_s: Longest delay to catch up, seconds.
        """
        self._period_s = period_s
        self._start_s = now_s
        self._num_past = 0
        self._max_owed = max(1, round(max_lag_s / period_s))
        self.num_lost = 0

    def due(self, now_s: float) -> int:
        """The number of steps to make now, 0 to `BURST`.

        Deadlines are rounded to the nearest, so that a timer of the same period gets one step each
        time, whether it fires a little early or late.

        Args:
            now_s: The time now.
        """
        past = math.floor((now_s - self._start_s) / self._period_s + 0.5)
        owed = max(0, past - self._num_past)
        lost = max(0, owed - self._max_owed)
        due = min(owed - lost, BURST)
        self.num_lost += lost
        self._num_past += lost + due
        return due
