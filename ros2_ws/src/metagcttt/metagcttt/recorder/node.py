"""The recorder node."""

from datetime import datetime, UTC
from functools import partial
from pathlib import Path
import time
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import RECORDER_NODE
from metagcttt.qos import recording_profile
from metagcttt.recorder.recording import message_class, Recording, UnknownTypeError

SEARCH_PERIOD_S = 0.1
QUIET_S = 0.2
GRACE_S = 1.2
OF_ALL_ROBOTS = ('/clock', '/diagnostics')
OF_OPERATORS = ('goal_pose',)
HEARD_S = 1.0
OF_ROS = ('/rosout', '/parameter_events')


class RecorderNode(Node):
    """Records every topic of its namespace, and those that all robots share.

    Serialized messages go to the file unchanged. A subscription follows the QoS of the topic's
    publishers. On topics that take orders it joins late and leaves with the last publisher:
    `ros2 topic pub --once` sends as soon as anybody listens, and an order that only the recorder
    hears is lost.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Create the file and start to discover topics.

        Args:
            kwargs: For `rclpy.node.Node`.

        Raises:
            OSError: If the file exists or cannot be written.
        """
        super().__init__('recorder_node', **kwargs)
        self._settings = ParameterSet(self, RECORDER_NODE, is_configured=lambda: True)
        output = self._settings['output'] or f'{datetime.now(UTC):rec-%Y%m%d-%H%M%S}.mcap'
        self._recording = Recording(
            Path(output).expanduser(), split_bytes=round(self._settings['split_mb'] * 1e6)
        )
        self._subscriptions_by_topic: dict[str, Subscription] = {}
        self._refused: set[str] = set()
        self._inputs = {self.resolve_topic_name(name) for name in OF_OPERATORS}
        self._published_since_s: dict[str, float] = {}
        # Not the node's clock, which stops when the simulation is paused.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(SEARCH_PERIOD_S, self._search, clock=steady)
        self.create_timer(self._settings['flush_s'], self._recording.flush, clock=steady)
        self.get_logger().info(f'recording to {output}')
        self._search()

    def destroy_node(self) -> None:
        """Record what is still in transit, finish the file and destroy the node.

        Ends after `QUIET_S` without a message, and after `GRACE_S` on a busy graph.
        """
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self)
        begin = heard = time.monotonic()
        while (now := time.monotonic()) < min(heard + QUIET_S, begin + GRACE_S):
            before = self._recording.num_messages
            executor.spin_once(timeout_sec=heard + QUIET_S - now)
            if self._recording.num_messages > before:
                heard = time.monotonic()
        executor.shutdown()
        super().destroy_node()
        self._recording.close()
        names = ', '.join(str(path) for path in self._recording.paths)
        self.get_logger().info(f'{self._recording.num_messages} messages in {names}')

    def _search(self) -> None:
        """Subscribe to new topics, and again to those whose QoS has changed."""
        for topic, types in self.get_topic_names_and_types():
            if not self._is_wanted(topic):
                continue
            publishers = [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]
            if topic in self._inputs and not self._is_heard(topic, bool(publishers)):
                continue
            if not publishers:
                continue
            profile = recording_profile(publishers)
            known = self._subscriptions_by_topic.get(topic)
            if known is None:
                self._subscribe(topic, types, profile)
            elif _quality(known.qos_profile) != _quality(profile):
                self.destroy_subscription(known)
                self._subscribe(topic, types, profile)

    def _is_heard(self, topic: str, is_published: bool) -> bool:
        """True once the readers of an input have had the time to be matched with its publisher."""
        now_s = time.monotonic()
        if is_published:
            return now_s - self._published_since_s.setdefault(topic, now_s) >= HEARD_S
        self._published_since_s.pop(topic, None)
        subscription = self._subscriptions_by_topic.pop(topic, None)
        if subscription is not None:
            self.destroy_subscription(subscription)
        return False

    def _is_wanted(self, topic: str) -> bool:
        if topic in OF_ROS or topic in self._refused:
            return False
        inside = topic.startswith(self.get_namespace().rstrip('/') + '/')
        return inside or topic in OF_ALL_ROBOTS

    def _subscribe(self, topic: str, types: list[str], profile: QoSProfile) -> None:
        try:
            if len(types) > 1:
                raise UnknownTypeError(f'it has several types: {", ".join(types)}')
            message_type = message_class(types[0])
            self._recording.add_topic(topic, types[0])
        except UnknownTypeError as error:
            self._refused.add(topic)
            self.get_logger().warning(f'{topic} is not recorded: {error}')
            return
        self._subscriptions_by_topic[topic] = self.create_subscription(
            message_type, topic, partial(self._on_message, topic), profile, raw=True
        )
        self.get_logger().info(f'recording {topic} ({types[0]})')

    def _on_message(self, topic: str, data: bytes, info: dict[str, int]) -> None:
        received = time.time_ns()
        published = info['source_timestamp'] or received
        # Simulated time may run so fast that this node's own delay would matter.
        is_simulated = self.get_parameter('use_sim_time').value
        self._recording.add(
            topic,
            data,
            log_time=published if is_simulated else received,
            publish_time=published,
        )


def _quality(profile: QoSProfile) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
    return profile.reliability, profile.durability
