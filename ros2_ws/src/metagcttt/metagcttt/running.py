"""A node as a process that ends cleanly."""

from collections.abc import Callable
import faulthandler
import sys
import threading
import time
from typing import TypeVar

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from metagcttt.guard import GuardedExecutor
from metagcttt.parameter_files import warn_of_unused_files
from metagcttt.signals import ignore_signals, only_set

FAREWELL_S = 0.3
LONGEST_END_S = 60.0
"""An end that takes longer hangs: the process says where, and ends."""

AnyNode = TypeVar('AnyNode', bound=Node)


def run(
    make_node: Callable[[], AnyNode],
    stop: threading.Event,
    farewell: Callable[[AnyNode], None] | None = None,
) -> int:
    """Spin a node until `stop` is set and shut everything down in the order that leaves no error.

    Args:
        make_node: Creates the node, whose `destroy_node` must join the threads it started.
        stop: From `stop_on_signals`.
        farewell: Called at the end; the node is then spun a moment longer, to send its messages.

    Returns:
        Exit code: 0 after a stop, 1 when the node could not be created; the log says why.

    Raises:
        SystemExit: With code 0, by a signal while the node is created.
    """
    # rclpy's own handlers shut the context down while the executor uses it.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        try:
            node = make_node()
        except (OSError, ValueError, ParameterException) as error:
            get_logger('metagcttt').fatal(f'cannot start: {error}')
            return 1
        warn_of_unused_files(node, sys.argv)
        only_set(stop)
        _spin(node, stop, farewell)
    finally:
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()
    return 0


def _spin(
    node: AnyNode, stop: threading.Event, farewell: Callable[[AnyNode], None] | None
) -> None:
    executor = GuardedExecutor()
    executor.add_node(node)
    try:
        while not stop.is_set():
            executor.spin_once(timeout_sec=0.1)
    finally:
        ignore_signals()
        faulthandler.dump_traceback_later(LONGEST_END_S, exit=True)
        if farewell is not None:
            farewell(node)
            end = time.monotonic() + FAREWELL_S
            while (left := end - time.monotonic()) > 0:
                executor.spin_once(timeout_sec=left)
        executor.shutdown()
        node.destroy_node()
