"""What every node says of itself on /diagnostics."""

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from metagcttt.health import Health


def status_message(name: str, hardware_id: str, health: Health) -> DiagnosticStatus:
    """A node's health as a message."""
    return DiagnosticStatus(
        level=bytes([health.level]),
        name=name,
        message=health.message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in health.values.items()],
    )


class Diagnostics:
    """Publishes a node's health once per period, whatever the node's clock does."""

    def __init__(self, node: Node, examine: Callable[[], Health], period_s: float) -> None:
        """Begin.

        Args:
            node: The node.
            examine: Its health now.
            period_s: Seconds between two messages.
        """
        self._node = node
        self._examine = examine
        # The topic is absolute by convention; the status names the node in full.
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(period_s, self.publish, clock=steady)

    def publish(self) -> None:
        """Say it now."""
        name = self._node.get_fully_qualified_name()
        message = DiagnosticArray(status=[status_message(name, '', self._examine())])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
