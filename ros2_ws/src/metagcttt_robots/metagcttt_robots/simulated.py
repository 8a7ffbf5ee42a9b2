"""What the simulated robots have in common: their time, and sensors that are late."""

from abc import ABC, abstractmethod
from collections.abc import Callable
import heapq
from itertools import count
from typing import Any

import numpy as np
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Header

RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
SENSOR = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


def number(
    node: Node, name: str, default: float, low: float, high: float, description: str
) -> float:
    """The value of a parameter that is declared with a range and cannot change."""
    bounds = FloatingPointRange(from_value=low, to_value=high, step=0.0)
    descriptor = ParameterDescriptor(
        description=description, read_only=True, floating_point_range=[bounds]
    )
    return float(node.declare_parameter(name, default, descriptor).value)


class SimulatedRobot(Node, ABC):
    """Simulated time, which `/clock` tells, at the pace of a factor or of the commands.

    With `speed_factor` 0 a period passes when a command has come, and after `patience_s` without
    one: as fast as the one who commands, and no faster on a machine that is busy.
    """

    def __init__(self, name: str, rate_hz: float, advance: Callable[[float], None]) -> None:
        """Declare the parameters; `start` begins.

        Args:
            name: Of the node.
            rate_hz: Of its sensors.
            advance: Lets so many seconds pass in the simulation.
        """
        super().__init__(name)
        self.period_ns = round(1e9 / rate_hz)
        self.time_ns = 0
        self._advance = advance
        factor = number(
            self,
            *('speed_factor', 1.0, 0.0, 100.0),
            'simulated seconds per second; 0: as fast as commands come',
        )
        self._patience_s = number(
            self, 'patience_s', 0.2, 0.001, 60.0, 'speed_factor 0: longest wait for a command, s'
        )
        seed = number(self, 'seed', 0.0, 0.0, 1e9, 'of noise and losses')
        self._latency_s = number(self, 'latency_s', 0.0, 0.0, 10.0, 'age of sensor messages, s')
        self._late = number(
            self, 'late_share', 0.0, 0.0, 1.0, 'share of sensor messages two periods later'
        )
        self._lost = number(self, 'lost_share', 0.0, 0.0, 1.0, 'share of sensor messages lost')
        self.rng = np.random.default_rng(int(seed))
        self._by_commands = factor == 0
        self._under_way: list[tuple[int, int, Publisher, Any]] = []
        self._order = count()
        self._clock_messages = self.create_publisher(ClockMessage, '/clock', SENSOR)
        period_s = self._patience_s if self._by_commands else self.period_ns / 1e9 / factor
        # Not the node's own clock, which may be the simulated one.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(period_s, self._on_timer, clock=steady)
        self._unanswered, self._answered = 0, False

    @abstractmethod
    def sense(self) -> None:
        """Send what the sensors say now."""

    def header(self, frame_id: str) -> Header:
        """A header with the simulated time."""
        header = Header(frame_id=frame_id)
        header.stamp.sec, header.stamp.nanosec = divmod(self.time_ns, 10**9)
        return header

    def send(self, publisher: Publisher, message: Any) -> None:
        """Send a sensor's message: late or never, as the parameters say."""
        if self.rng.uniform() < self._lost:
            return
        late_ns = 2 * self.period_ns if self.rng.uniform() < self._late else 0
        due_ns = self.time_ns + round(self._latency_s * 1e9) + late_ns
        heapq.heappush(self._under_way, (due_ns, next(self._order), publisher, message))

    def commanded(self) -> None:
        """A command has come, which lets a period pass once it is that for the last one.

        A command that took longer than the patience is followed by those for the periods that
        passed meanwhile; without waiting for them too, commands would lag from then on.
        """
        self._answered = True
        self._unanswered -= 1
        if self._by_commands:
            self._timer.reset()
            if self._unanswered <= 0:
                self._pass()

    def _on_timer(self) -> None:
        if self._answered:  # and no more answers come
            self._unanswered = 0
        self._pass()

    def _pass(self) -> None:
        self._answered = False
        self._unanswered = min(max(self._unanswered, 0) + 1, 2)
        self._advance(self.period_ns / 1e9)
        self.time_ns += self.period_ns
        self.sense()
        while self._under_way and self._under_way[0][0] <= self.time_ns:
            _, _, publisher, message = heapq.heappop(self._under_way)
            publisher.publish(message)
        clock = ClockMessage()
        clock.clock = self.header('').stamp
        self._clock_messages.publish(clock)
