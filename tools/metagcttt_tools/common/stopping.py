"""How a run ends early: saved, and with a status that says whether to queue it again."""

from collections.abc import Iterator
from contextlib import contextmanager
import signal
import threading
import time

INTERRUPTED = 130
"""Status after Ctrl-C, as of a shell: somebody wanted an end."""
REQUEUE = 75
"""Status after SIGTERM, SIGUSR1 or the time limit: EX_TEMPFAIL of sysexits.h, try again later."""


class Stop:
    """Whether a run should save and end, and with which status.

    Attributes:
        status: `INTERRUPTED` once Ctrl-C was what came first, otherwise `REQUEUE`.
    """

    def __init__(self, time_limit: float | None = None) -> None:
        """Nothing has come yet.

        Args:
            time_limit: Seconds from now after which the run should end.
        """
        self.status = REQUEUE
        self._event = threading.Event()
        self._deadline = None if time_limit is None else time.monotonic() + time_limit

    def set(self, signum: int = signal.SIGTERM) -> None:
        """Ask for the end, as that signal does."""
        if not self._event.is_set():
            self.status = INTERRUPTED if signum == signal.SIGINT else REQUEUE
        self._event.set()

    def is_set(self) -> bool:
        """True from the first signal, or from the time limit on."""
        if self._deadline is not None and time.monotonic() >= self._deadline:
            self.set()
        return self._event.is_set()

    def wait(self, timeout_s: float) -> bool:
        """`is_set`, after so many seconds or as soon as a signal comes."""
        self._event.wait(timeout_s)
        return self.is_set()


@contextmanager
def stop_on_signal(time_limit: float | None = None) -> Iterator[Stop]:
    """Set by Ctrl-C, SIGTERM, SIGUSR1 or the time limit, so that a run can save before it ends."""
    stop = Stop(time_limit)
    previous = {
        number: signal.signal(number, lambda signum, _: stop.set(signum))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
    }
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
