"""Publisher of a node's health on /diagnostics."""

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from metagcttt.health import Health


class Diagnostics:
    """Publishes a node's health periodically, by a steady clock."""

    def __init__(self, node: Node, examine: Callable[[], Health], period_s: float) -> None:
        """Create the publisher and its timer.

        Args:
            node: The node.
            examine: Returns its current health.
            period_s: Seconds between two messages.
        """
        self._node = node
        self._examine = examine
        # The topic is absolute by convention; the status names the node in full.
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(period_s, self.publish, clock=steady)

    def publish(self) -> None:
        """Publish the current health."""
        health = self._examine()
        status = DiagnosticStatus(
            level=bytes([health.level]),
            name=self._node.get_fully_qualified_name(),
            message=health.message,
            values=[KeyValue(key=key, value=value) for key, value in health.values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
