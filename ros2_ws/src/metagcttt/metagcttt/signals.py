"""Ctrl-C and SIGTERM from the first moment on. Imports nothing that takes long."""

import signal
import threading
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def stop_on_signals() -> threading.Event:
    """Let Ctrl-C and SIGTERM end the process cleanly from now on.

    During the start they raise SystemExit(0), because an import or the loading of a policy may
    take longer than anybody waits for an end; `only_set` ends that phase.

    Returns:
        An event that they set as well.
    """
    stop = threading.Event()

    def end_the_start(signum: int, frame: FrameType | None) -> None:
        stop.set()  # should somebody on the way swallow the exception
        raise SystemExit(0)

    for number in SIGNALS:
        signal.signal(number, end_the_start)
    return stop


def only_set(stop: threading.Event) -> None:
    """From now on the signals do no more than set `stop`, which somebody looks at all the time."""

    def request_stop(signum: int, frame: FrameType | None) -> None:
        stop.set()

    for number in SIGNALS:
        signal.signal(number, request_stop)


def ignore_signals() -> None:
    """From now on they do nothing: the end is under way."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
