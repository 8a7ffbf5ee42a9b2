"""Entry points of the executables. Slow imports wait until signals are handled.

The guard is this package's own: the robots stand in for a user's and know nothing of `metagcttt`.
"""

from collections.abc import Callable
import signal
import threading
import traceback

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node


def arm() -> int:
    """Run the arm until Ctrl-C or SIGTERM; returns the exit code."""

    def make() -> Node:
        from metagcttt_robots.arm_node import ArmNode

        return ArmNode()

    return _run(make)


def arm_driver() -> int:
    """Drive the arm until Ctrl-C or SIGTERM; returns the exit code."""

    def make() -> Node:
        from metagcttt_robots.arm_driver import ArmDriver

        return ArmDriver()

    return _run(make)


def diffbot() -> int:
    """Run the robot with two wheels until Ctrl-C or SIGTERM; returns the exit code."""

    def make() -> Node:
        from metagcttt_robots.diffbot_node import DiffbotNode

        return DiffbotNode()

    return _run(make)


def diffbot_driver() -> int:
    """Drive the robot with two wheels until Ctrl-C or SIGTERM; returns the exit code."""

    def make() -> Node:
        from metagcttt_robots.diffbot_driver import DiffbotDriver

        return DiffbotDriver()

    return _run(make)


def _run(make_node: Callable[[], Node]) -> int:
    """Spin a node until a signal comes, which rclpy's own handlers would not survive.

    A message that a callback cannot take is logged; it ends no node.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = make_node()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stop.is_set():
        try:
            executor.spin_once(timeout_sec=0.1)
        except Exception as error:  # noqa: BLE001 - this is the guard
            text = ''.join(traceback.format_exception(error))
            node.get_logger().error(f'a callback failed: {text}', throttle_duration_sec=1.0)
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
    return 0
