"""A program's view of a simulated robot with a contract: put it somewhere, send a goal, watch."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import math
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from metagcttt.commander import NoAnswerError, RobotCommander
from metagcttt_core.robot import Contract
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import AdaptationReport, MazeState
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

Goal = tuple[float, float] | Mapping[str, float]

_EVERY = QoSProfile(
    depth=2000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
_ANY = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
_PLACED_M = 0.05
_ENDS = (ReachGoal.Result.NONE, ReachGoal.Result.TIMED_OUT)


@dataclass(frozen=True)
class RobotOutcome:
    """The outcome of one goal.

    Attributes:
        success: Whether the goal was reached.
        seconds: Simulated time from the goal's acceptance to its end.
        steps: Control periods in that time.
        missed: Control periods in which the policy did not answer the newest state in time.
        path: (x, y) in metres at each step; zeros for a robot without a position.
        report: The adaptation to this goal.
    """

    success: bool
    seconds: float
    steps: int
    missed: int
    path: list[tuple[float, float]]
    report: AdaptationReport


@dataclass
class _Watched:
    """Messages since the last reset."""

    states: list[MazeState] = field(default_factory=list)
    reports: list[AdaptationReport] = field(default_factory=list)


class RobotClient(RobotCommander):
    """Places a simulated robot and sends it to goals, by `initialpose` and `reach_goal`."""

    def __init__(self, check_processes: Callable[[], None], contract: Contract) -> None:
        """Join the graph.

        Args:
            check_processes: Called while waiting; raises when a node process has died.
            contract: Of the robot.
        """
        super().__init__(
            name='robot_client', frame_id=contract.frame_id, while_waiting=check_processes
        )
        self._seen = _Watched()
        self._missed = self._num_diagnoses = 0  # by the policy
        self._places = self.create_publisher(PoseWithCovarianceStamped, 'initialpose', 10)
        self.create_subscription(
            MazeState, 'state', lambda state: self._seen.states.append(state), _ANY
        )
        self._reports = self.create_subscription(
            AdaptationReport,
            'adaptation',
            lambda report: self._seen.reports.append(report),
            _EVERY,
        )
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)

    def wait_until_ready(self, timeout_s: float = 30.0) -> None:
        """Wait until robot, bridge, goal node and policy hear each other and this program."""
        for found, what in (
            (self._reach_goal.server_is_ready, 'action reach_goal'),
            (lambda: self.count_subscribers('action'), 'a subscriber of action'),
            (lambda: self.count_subscribers('goal'), 'a subscriber of goal'),
            (self._reports.get_publisher_count, 'a publisher of adaptation'),
            (lambda: self._num_diagnoses, "the policy's diagnostics"),
            (lambda: self._seen.states, 'the state of the robot'),
        ):
            self.wait(found, what, timeout_s)

    def place(self, x: float, y: float, yaw: float, timeout_s: float) -> None:
        """Put the robot somewhere (metres, radians), at rest, and wait until it is seen there."""
        self.wait(self._places.get_subscription_count, 'a subscriber of initialpose', timeout_s)
        message = PoseWithCovarianceStamped()
        message.pose.pose.position.x, message.pose.pose.position.y = x, y
        message.pose.pose.orientation.z = math.sin(yaw / 2)
        message.pose.pose.orientation.w = math.cos(yaw / 2)
        self._places.publish(message)
        self._seen.states.clear()
        self.wait(
            lambda: any(
                math.dist((s.position.x, s.position.y), (x, y)) < _PLACED_M
                for s in self._seen.states[-1:]
            ),
            f'the robot at ({x:g}, {y:g})',
            timeout_s,
        )

    def drive(
        self,
        goal: Goal,
        start: tuple[float, float, float] | None = None,
        max_s: float = 0.0,
        timeout_s: float = 60.0,
    ) -> RobotOutcome:
        """Send a goal, from a start if there is one, and watch what becomes of it.

        Args:
            goal: Position in metres, or values by the names of the contract.
            start: Where to put the robot first: x, y (m) and yaw (rad).
            max_s: Simulated seconds that it may take; 0 for the contract's.
            timeout_s: Longest wait for anything, seconds.
        """
        if start is not None:
            self.place(*start, timeout_s)
        self._seen = _Watched()
        missed = self._missed
        sent = self.send(goal, max_s=max_s, timeout_s=timeout_s)
        result = sent.result(timeout_s)
        if result.error_code not in _ENDS:
            raise NoAnswerError(f'the goal {goal} came to nothing: {result.error_msg}')
        path = [(s.position.x, s.position.y) for s in self._seen.states]
        self.wait(lambda: self._seen.reports, 'the adaptation report', timeout_s)
        self._await_diagnostics(timeout_s)
        return RobotOutcome(
            success=result.success,
            seconds=result.seconds,
            steps=result.steps,
            missed=self._missed - missed,
            path=path,
            report=self._seen.reports[0],
        )

    def _await_diagnostics(self, timeout_s: float) -> None:
        """Wait for figures of the policy that are newer than this call."""
        since = self._num_diagnoses
        self.wait(lambda: self._num_diagnoses > since, "the policy's diagnostics", timeout_s)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values: dict[str, Any] = {each.key: each.value for each in status.values}
            if status.name == '/policy_node' and 'missed_deadlines' in values:
                self._missed = int(values['missed_deadlines'])
                self._num_diagnoses += 1
