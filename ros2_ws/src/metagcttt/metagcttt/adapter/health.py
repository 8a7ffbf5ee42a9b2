"""Adapter health."""

from collections import Counter
import time

from metagcttt.adapter.requests import Ended, Ending
from metagcttt.health import Faults, Health, Level, Samples


class AdapterMonitor:
    """Counts what becomes of requests and judges the adapter's health.

    Attributes:
        engine: What computed the last gradient steps.
    """

    def __init__(self, engine: str) -> None:
        """Start with empty statistics; `engine` as in `Adaptation.engine`."""
        self.engine = engine
        self._accepted = 0
        self._ends: Counter[Ending] = Counter()
        self._refusals = Faults()
        self._failures = Faults()
        self._wait_ms = Samples()
        self._adapt_ms = Samples()

    def accepted(self) -> None:
        """Record a request that was queued."""
        self._accepted += 1

    def refused(self, kind: str, reason: str) -> None:
        """Record a request that was refused, with the name of its error code."""
        self._refusals.note(kind.lower(), reason, time.monotonic())

    def ended(self, ended: Ended, adapt_ms: float = 0.0) -> None:
        """Record the end of a request; `adapt_ms` is the time of its inner loop if it is done."""
        self._ends[ended.ending] += 1
        if ended.ending == Ending.DONE:
            self._wait_ms.add(ended.wait_ms)
            self._adapt_ms.add(adapt_ms)
        elif ended.ending == Ending.FAILED:
            self._failures.note('failed', ended.reason, time.monotonic())

    def examine(
        self, *, waiting: int, running: int, workers: int, size: int, robots: int
    ) -> Health:
        """The current health.

        Args:
            waiting: Requests in the queue.
            running: Requests worked on.
            workers: Requests that can be worked on at a time.
            size: Requests that can wait.
            robots: Robots served.
        """
        now_s = time.monotonic()
        values = {
            'requests_waiting': str(waiting),
            'requests_running': str(running),
            'workers': str(workers),
            'queue': str(size),
            'robots': str(robots),
            'accepted': str(self._accepted),
            **{each.name.lower(): str(self._ends[each]) for each in Ending},
            **{f'refused_{kind}': str(n) for kind, n in sorted(self._refusals.counts.items())},
            'wait_median_ms': f'{self._wait_ms.percentile(50):.1f}',
            'wait_p99_ms': f'{self._wait_ms.percentile(99):.1f}',
            'adapt_median_ms': f'{self._adapt_ms.percentile(50):.1f}',
            'adapt_p99_ms': f'{self._adapt_ms.percentile(99):.1f}',
            'adapt_engine': self.engine,
        }
        if recent := self._failures.recent(now_s):
            return Health(Level.ERROR, f'just now: {recent}', values)
        if recent := self._refusals.recent(now_s):
            return Health(Level.WARN, f'refused just now: {recent}', values)
        message = f'{running} of {workers} workers busy, {waiting} requests wait'
        return Health(Level.OK, message, values)
