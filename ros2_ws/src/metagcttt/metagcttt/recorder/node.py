"""The recorder node."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, UTC
from functools import partial
from pathlib import Path
import time
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from metagcttt.conventions import ConventionalNode
from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import RECORDER_NODE
from metagcttt.qos import recording_profile
from metagcttt.recorder.recording import message_class, Recording, UnknownTypeError

SEARCH_PERIOD_S = 0.1
QUIET_S = 0.5
TOLD_S = 5.0
DRAIN_S = 0.1
GRACE_S = 2.0
OF_ALL_ROBOTS = ('/clock', '/diagnostics')
ORDERS = ('goal_pose', 'stop')
OF_ROS = ('/rosout', '/parameter_events')


class RecorderNode(ConventionalNode):
    """Records every topic of its namespace, and those that all robots share.

    Serialized messages go to the file unchanged. A subscription follows the QoS of the topic's
    publishers. It never listens to the topics that take orders: `ros2 topic pub --once` sends as
    soon as anybody listens, and an order that only the recorder hears is lost. What became of a
    goal is on `goal` and `episode`, of a stop on `/diagnostics`.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Create the file and start to discover topics.

        Args:
            kwargs: For `rclpy.node.Node`.

        Raises:
            OSError: If the file or folder exists or cannot be written.
            ValueError: If the output is of another kind.
        """
        super().__init__('recorder_node', **kwargs)
        self._settings = ParameterSet(self, RECORDER_NODE, is_configured=lambda: True)
        output = self._settings['output'] or f'{datetime.now(UTC):rec-%Y%m%d-%H%M%S}.mcap'
        self._recording = Recording(
            Path(output).expanduser(), split_bytes=round(self._settings['split_mb'] * 1e6)
        )
        self._subscriptions_by_topic: dict[str, Subscription] = {}
        self._refused: set[str] = set()
        # Not the node's clock, which stops when the simulation is paused.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(SEARCH_PERIOD_S, self._search, clock=steady)
        self.create_timer(self._settings['flush_s'], self._flush, clock=steady)
        self.get_logger().info(f'recording to {output}')
        self._search()

    def destroy_node(self) -> None:
        """Record what is still in transit, finish the file and destroy the node.

        Where all end together, those that publish here end first, so that their last words are
        recorded; a graph that goes on is left after `GRACE_S`, a quiet one after `QUIET_S`.
        """
        self._flush()
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self)
        begin = heard = time.monotonic()
        while (now := time.monotonic()) < begin + GRACE_S:
            is_published = any(map(self.count_publishers, self._subscriptions_by_topic))
            if now > heard + (QUIET_S if is_published else DRAIN_S):
                break
            before = self._recording.num_messages
            executor.spin_once(timeout_sec=DRAIN_S / 2)
            if self._recording.num_messages > before:
                heard = time.monotonic()
        executor.shutdown()
        super().destroy_node()
        with self._telling():
            self._recording.close()
        names = ', '.join(str(path) for path in self._recording.paths)
        self.get_logger().info(f'{self._recording.num_messages} messages in {names}')

    def _search(self) -> None:
        """Subscribe to new topics, and again to those whose QoS has changed."""
        for topic, types in self.get_topic_names_and_types():
            if not self._is_wanted(topic):
                continue
            publishers = self.get_publishers_info_by_topic(topic)
            if not publishers:
                continue
            profile = recording_profile([info.qos_profile for info in publishers])
            known = self._subscriptions_by_topic.get(topic)
            if known is not None and _quality(known.qos_profile) == _quality(profile):
                continue
            if known is not None:
                self.destroy_subscription(known)
            self._subscribe(topic, types, profile, publishers)

    def _is_wanted(self, topic: str) -> bool:
        if topic in OF_ROS or topic in self._refused or topic.rpartition('/')[2] in ORDERS:
            return False
        is_hidden = any(name.startswith('_') for name in topic.split('/'))
        if is_hidden and not self._settings['hidden_topics']:
            return False
        inside = topic.startswith(self.get_namespace().rstrip('/') + '/')
        return inside or topic in OF_ALL_ROBOTS

    def _subscribe(
        self,
        topic: str,
        types: list[str],
        profile: QoSProfile,
        publishers: list[TopicEndpointInfo],
    ) -> None:
        type_hash = str(publishers[0].topic_type_hash).removeprefix('INVALID')
        offered = [info.qos_profile for info in publishers]
        try:
            if len(types) > 1:
                raise UnknownTypeError(f'it has several types: {", ".join(types)}')
            message_type = message_class(types[0])
            self._recording.add_topic(topic, types[0], offered, type_hash)
        except UnknownTypeError as error:
            self._refused.add(topic)
            self.get_logger().warning(f'{topic} is not recorded: {error}')
            return
        self._subscriptions_by_topic[topic] = self.create_subscription(
            message_type,
            topic,
            partial(self._on_message, topic),
            profile,
            raw=True,
            qos_overriding_options=QoSOverridingOptions(()),  # it follows the publishers
        )
        self.get_logger().info(f'recording {topic} ({types[0]})')

    def _on_message(self, topic: str, data: bytes, info: dict[str, int]) -> None:
        # Both of the system clock; the stamp in a header may be simulated, and stays inside.
        received = time.time_ns()
        published = info['source_timestamp'] or received
        # Simulated time may run so fast that this node's own delay would matter.
        is_simulated = self.get_parameter('use_sim_time').value
        with self._telling():
            self._recording.add(
                topic,
                data,
                log_time=published if is_simulated else received,
                publish_time=published,
            )

    def _flush(self) -> None:
        with self._telling():
            self._recording.flush()

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """Says what cannot be written, and what is lost meanwhile; it is tried again."""
        try:
            yield
        except OSError as error:
            self.get_logger().error(
                f'nothing can be recorded: {error}; {self._recording.paths[-1]} is whole up to '
                f'here, {self._recording.num_lost} messages are lost since',
                throttle_duration_sec=TOLD_S,
            )


def _quality(profile: QoSProfile) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
    return profile.reliability, profile.durability
