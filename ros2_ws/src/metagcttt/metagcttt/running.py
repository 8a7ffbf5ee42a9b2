"""Run one node as a process that ends cleanly."""

from collections.abc import Callable
import signal
import threading
from types import FrameType
from typing import TypeVar

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

SIGNALS = (signal.SIGINT, signal.SIGTERM)
FAREWELL_SPINS = 10

AnyNode = TypeVar('AnyNode', bound=Node)


def stop_on_signals() -> threading.Event:
    """An event that Ctrl-C and SIGTERM set from now on, instead of ending the process.

    Call it before anything slow is imported, so that a signal during the start ends the process
    as cleanly as a later one.
    """
    stop = threading.Event()

    def request_stop(signum: int, frame: FrameType | None) -> None:
        stop.set()

    for number in SIGNALS:
        signal.signal(number, request_stop)
    return stop


def run(
    make_node: Callable[[], AnyNode],
    stop: threading.Event,
    farewell: Callable[[AnyNode], None] | None = None,
) -> int:
    """Spin a node until `stop` is set and take everything down in the order that leaves no error.

    Args:
        make_node: Makes the node. Its `destroy_node` has to join the threads it started.
        stop: From `stop_on_signals`.
        farewell: Says goodbye to those who rely on the node, which is spun a moment longer.

    Returns:
        Exit code: 0 after a stop, 1 when the node could not be made; the log says why.
    """
    # rclpy's own handlers shut the context down under the executor's feet.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = make_node()
    except (OSError, ValueError, ParameterException) as error:
        get_logger('metagcttt').fatal(f'cannot start: {error}')
        rclpy.try_shutdown()
        return 1
    except ImportError:
        # The signal also ended the process in which glfw looks for its library.
        if not stop.is_set():
            raise
        rclpy.try_shutdown()
        return 0
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not stop.is_set():
            executor.spin_once(timeout_sec=0.1)
    finally:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        if farewell is not None:
            farewell(node)
            for _ in range(FAREWELL_SPINS):
                executor.spin_once(timeout_sec=0.02)
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0
