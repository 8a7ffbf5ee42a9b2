"""Nodes in one process, spun by the test until what it waits for has happened."""

from collections.abc import Callable
from itertools import groupby
import time
from typing import Any, TypeVar

from geometry_msgs.msg import PoseStamped
from metagcttt_interfaces.msg import (
    ActionCommand,
    AdaptationReport,
    EpisodeEvent,
    GoalQuery,
    MazeState,
)
from metagcttt_interfaces.srv import SetTask
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

EVERY = QoSProfile(
    depth=5000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
RELIABLE = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
ANY = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)

LAST_SPINS = 10

AnyNode = TypeVar('AnyNode', bound=Node)


class Graph:
    """A context, an executor and a node of the test's own."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Node] = []
        self._collecting: list[Subscription] = []
        self.node = self.add(Node)

    def add(self, make: Callable[..., AnyNode], **parameters: Any) -> AnyNode:
        """Make a node with these parameters and spin it from now on."""
        name = ('test_node',) if make is Node else ()
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = make(*name, context=self.context, parameter_overrides=overrides)
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def remove(self, node: Node) -> None:
        """Take a node out and destroy it."""
        self._nodes.remove(node)
        self._executor.remove_node(node)
        node.destroy_node()

    def wait(self, condition: Callable[[], Any], what: str, timeout_s: float = 60.0) -> Any:
        """Spin until `condition` gives something true and return that.

        Raises:
            AssertionError: If it does not within `timeout_s`; names `what`.
        """
        deadline = time.monotonic() + timeout_s
        while not (result := condition()):
            assert time.monotonic() < deadline, f'waited {timeout_s:g} s in vain for {what}'
            self._executor.spin_once(timeout_sec=0.05)
        return result

    def wait_for(self, seconds: float) -> None:
        """Spin for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.02)

    def collect(self, message_type: type, topic: str, profile: QoSProfile = EVERY) -> list[Any]:
        """A list that grows by every message of a topic."""
        messages: list[Any] = []
        self._collecting.append(
            self.node.create_subscription(message_type, topic, messages.append, profile)
        )
        return messages

    def wait_for_publishers(self, timeout_s: float = 60.0) -> None:
        """Wait until every topic that is collected has a publisher that reaches this process."""
        for subscription in self._collecting:
            what = f'a publisher of {subscription.topic_name}'
            self.wait(subscription.get_publisher_count, what, timeout_s)

    def publish(self, topic: str, message: Any, profile: QoSProfile = RELIABLE) -> None:
        """Publish one message, once somebody listens."""
        publisher = self.node.create_publisher(type(message), topic, profile)
        self.wait(publisher.get_subscription_count, f'a subscriber of {topic}')
        publisher.publish(message)

    def call(self, service_type: type, name: str, request: Any) -> Any:
        """Call a service and return its response."""
        client = self.node.create_client(service_type, name)
        self.wait(client.service_is_ready, f'service {name}')
        future = client.call_async(request)
        self.wait(future.done, f'the response of {name}')
        self.node.destroy_client(client)
        return future.result()

    def set_task(self, task_id: int, seed: int = 0, *, send_goal: bool = True) -> SetTask.Response:
        """Call set_task."""
        request = SetTask.Request(task_id=task_id, seed=seed, send_goal=send_goal)
        return self.call(SetTask, 'set_task', request)

    def close(self) -> None:
        """Destroy everything, after what was begun: rclpy gives results in tasks."""
        for _ in range(LAST_SPINS):
            self._executor.spin_once(timeout_sec=0)
        self._executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
        self.context.try_shutdown()


class Record:
    """Everything that the graph says."""

    def __init__(self, graph: Graph, state_profile: QoSProfile = ANY) -> None:
        self.states: list[MazeState] = graph.collect(MazeState, 'state', state_profile)
        self.actions: list[ActionCommand] = graph.collect(ActionCommand, 'action', RELIABLE)
        self._queries: list[GoalQuery] = graph.collect(GoalQuery, 'goal')
        self.events: list[EpisodeEvent] = graph.collect(EpisodeEvent, 'episode')
        self.reports: list[AdaptationReport] = graph.collect(AdaptationReport, 'adaptation')

    @property
    def queries(self) -> list[GoalQuery]:
        """Goals as they were given; the goal node repeats the one in force."""
        return [query for query, _ in groupby(self._queries)]

    def of_kind(self, kind: int) -> list[EpisodeEvent]:
        """Events of one kind."""
        return [event for event in self.events if event.kind == kind]


def goal_pose(x: float, y: float, frame_id: str = 'map') -> PoseStamped:
    """What RViz's goal tool would publish."""
    pose = PoseStamped()
    pose.header.frame_id = frame_id
    pose.pose.position.x = x
    pose.pose.position.y = y
    pose.pose.orientation.w = 1.0
    return pose
