"""A stand-in for simulator and goal node that times the policy's answers."""

from collections.abc import Callable
from dataclasses import dataclass, field
import time

from metagcttt.commander import NoAnswerError
from metagcttt_interfaces.msg import ActionCommand, AdaptationReport, GoalQuery, MazeState
import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

_EPISODE = 1
_LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
_RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)


@dataclass
class Answers:
    """Observed answers of the policy over a period; times in seconds.

    Attributes:
        sent: When each state was published, by step.
        first: When its first action arrived, by step.
        serving: When the first action for each goal arrived, by goal.
        adapted: When the first action of its expert arrived, by goal.
        reports: The adaptations that ended.
    """

    sent: dict[int, float] = field(default_factory=dict)
    first: dict[int, float] = field(default_factory=dict)
    serving: dict[int, float] = field(default_factory=dict)
    adapted: dict[int, float] = field(default_factory=dict)
    reports: list[AdaptationReport] = field(default_factory=list)

    def latencies_ms(self) -> np.ndarray:
        """From a state to its first action, milliseconds; states without one are left out."""
        return np.array(
            [1e3 * (self.first[s] - self.sent[s]) for s in self.sent if s in self.first]
        )

    def missed(self, period_s: float) -> int:
        """States without an action when the next one was due."""
        never = float('inf')
        return sum(self.first.get(s, never) - at > period_s for s, at in self.sent.items())


class StateSource(Node):
    """Publishes states at a fixed rate and goals on demand."""

    def __init__(
        self, observations: np.ndarray, rate_hz: float, check_process: Callable[[], None]
    ) -> None:
        """Join the graph.

        Args:
            observations: (N, obs_dim) states to publish, one after the other, over and over.
            rate_hz: States per second.
            check_process: Called all the time; raises when the policy's process has died.
        """
        super().__init__('state_source')
        self._observations = observations
        self.period_s = 1.0 / rate_hz
        self._check_process = check_process
        self._step = 0
        self._query_id = 0
        self.seen = Answers()
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._states = self.create_publisher(MazeState, 'state', _LATCHED)
        self._goals = self.create_publisher(GoalQuery, 'goal', _LATCHED)
        self._policy_parameters = self.create_client(SetParameters, 'policy_node/set_parameters')
        self.create_subscription(ActionCommand, 'action', self._on_action, _RELIABLE)
        self.create_subscription(
            AdaptationReport, 'adaptation', lambda m: self.seen.reports.append(m), _RELIABLE
        )

    def wait_until_ready(self, timeout_s: float) -> None:
        """Wait for the policy node."""
        deadline = time.monotonic() + timeout_s
        while not (
            self._policy_parameters.service_is_ready()
            and self._states.get_subscription_count()
            and self._goals.get_subscription_count()
            and self.count_publishers('action')
        ):
            self._check_process()
            if time.monotonic() > deadline:
                raise NoAnswerError(f'no policy_node within {timeout_s:g} s')
            self._executor.spin_once(timeout_sec=0.1)

    def configure_policy(self, **values: int | str) -> None:
        """Set parameters of the policy.

        Raises:
            NoAnswerError: If one is refused or nobody answers.
        """
        request = SetParameters.Request(
            parameters=[
                Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
            ]
        )
        future = self._policy_parameters.call_async(request)
        deadline = time.monotonic() + 10.0
        while not future.done():
            self._check_process()
            if time.monotonic() > deadline:
                raise NoAnswerError('set_parameters of policy_node does not answer')
            self._executor.spin_once(timeout_sec=0.1)
        for result in future.result().results:
            if not result.successful:
                raise NoAnswerError(f'policy_node refuses a parameter: {result.reason}')

    def send_goal(self, goal: np.ndarray, seed: int) -> tuple[int, float]:
        """Publish a goal; returns its number and when it was published."""
        self._query_id += 1
        query = GoalQuery(
            query_id=self._query_id,
            episode_id=_EPISODE,
            active=True,
            goal=[float(value) for value in goal],
            seed=seed,
        )
        now = time.perf_counter()
        self._goals.publish(query)
        return self._query_id, now

    def play(
        self,
        duration_s: float,
        *,
        until: Callable[[], bool] = lambda: False,
        every: Callable[[float], None] = lambda elapsed_s: None,
    ) -> Answers:
        """Publish states for a while and collect what the policy answers.

        Args:
            duration_s: How long, unless `until` holds before.
            until: Asked before every state.
            every: Called before every state with the seconds since the beginning.
        """
        self.seen = Answers()
        began = time.perf_counter()
        count = 0
        while (elapsed := time.perf_counter() - began) < duration_s and not until():
            self._check_process()
            every(elapsed)
            self._publish_state()
            count += 1
            while (left := began + count * self.period_s - time.perf_counter()) > 0:
                self._executor.spin_once(timeout_sec=left)
        return self.seen

    def _publish_state(self) -> None:
        self._step += 1
        row = self._observations[self._step % len(self._observations)]
        message = MazeState(
            episode_id=_EPISODE, step=self._step, observation=[float(value) for value in row]
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self.seen.sent[self._step] = time.perf_counter()
        self._states.publish(message)

    def _on_action(self, message: ActionCommand) -> None:
        now = time.perf_counter()
        self.seen.first.setdefault(message.step, now)
        if message.query_id:
            self.seen.serving.setdefault(message.query_id, now)
            if message.adapted:
                self.seen.adapted.setdefault(message.query_id, now)
