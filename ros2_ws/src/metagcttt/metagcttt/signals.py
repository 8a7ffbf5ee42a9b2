"""Handlers of Ctrl-C and SIGTERM from start-up on. Imports nothing slow."""

import atexit
import gc
import signal
import threading
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def stop_on_signals() -> threading.Event:
    """Handle Ctrl-C and SIGTERM so that they end the process cleanly.

    During start-up they raise SystemExit(0), because an import or the loading of a policy may
    take seconds; `only_set` ends that phase.

    Returns:
        An event that they set too.
    """
    stop = threading.Event()

    def end_the_start(signum: int, frame: FrameType | None) -> None:
        stop.set()  # in case the exception is swallowed on its way
        raise SystemExit(0)

    for number in SIGNALS:
        signal.signal(number, end_the_start)
    # The garbage collection at exit, over all that PyTorch imported, takes seconds.
    atexit.register(gc.freeze)
    return stop


def only_set(stop: threading.Event) -> None:
    """Make the signals only set `stop`, which the spinning loop polls."""

    def request_stop(signum: int, frame: FrameType | None) -> None:
        stop.set()

    for number in SIGNALS:
        signal.signal(number, request_stop)


def ignore_signals() -> None:
    """Ignore the signals, as the shutdown is under way."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
