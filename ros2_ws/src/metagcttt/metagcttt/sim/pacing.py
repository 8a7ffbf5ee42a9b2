"""How many steps of a simulation are due. No ROS in here."""

import math

BURST = 2
"""Steps made at once to make up for a delay; few, so that new actions come in between."""


class Pacer:
    """Counts steps against deadlines that are fixed from the start, so that delays do not add up.

    A delay is made up for little by little. What is beyond `max_lag_s` is lost and counted: the
    machine is too slow for the pace that was asked for.
    """

    def __init__(self, period_s: float, now_s: float, max_lag_s: float = 0.5) -> None:
        """Begin to count.

        Args:
            period_s: Time between two steps, seconds of the clock that `now_s` is read from.
            now_s: The time now; the first step is due one period later.
            max_lag_s: Longest delay that is made up for, seconds.
        """
        self._period_s = period_s
        self._start_s = now_s
        self._num_past = 0
        self._max_owed = max(1, round(max_lag_s / period_s))
        self.num_lost = 0

    def due(self, now_s: float) -> int:
        """Steps to make now, 0 to `BURST`.

        Deadlines are rounded to the nearest, so a timer of the same period gets one step each
        time, whether it is a little early or late.

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
