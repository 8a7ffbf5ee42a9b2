"""A program's view of the robot: put it at a task's start, publish a goal, watch what happens."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from metagcttt.commander import NoAnswerError, RobotCommander
from metagcttt_interfaces.msg import AdaptationReport, EpisodeEvent, MazeState
from metagcttt_interfaces.srv import SetTask
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time

# Also what a node said before it had discovered this program.
_EVERY = QoSProfile(
    depth=2000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


@dataclass
class GoalOutcome:
    """The outcome of one goal.

    Attributes:
        success: Whether the goal was reached.
        steps: Control steps from the goal's acceptance to its end.
        path: (x, y) in metres at each step.
        observations: What the robot observed at each step.
        goal: (x, y) of the goal in metres.
        report: The adaptation to this goal.
    """

    success: bool
    steps: int
    path: list[tuple[float, float]]
    observations: list[Sequence[float]]
    goal: tuple[float, float]
    report: AdaptationReport


@dataclass
class _Watched:
    """Messages since the last reset."""

    states: list[MazeState] = field(default_factory=list)
    events: list[EpisodeEvent] = field(default_factory=list)
    reports: list[AdaptationReport] = field(default_factory=list)


class MazeClient(RobotCommander):
    """Drives the graph by its public names: `set_task`, `goal_pose`, `episode`, `adaptation`."""

    def __init__(self, check_processes: Callable[[], None], **kwargs: Any) -> None:
        """Join the graph.

        Args:
            check_processes: Called while waiting; raises when a node process has died.
            kwargs: For `RobotCommander`.
        """
        super().__init__(name='maze_client', while_waiting=check_processes, **kwargs)
        self._seen = _Watched()
        self._goal_pose = self.create_publisher(PoseStamped, 'goal_pose', 10)
        self.create_subscription(
            MazeState, 'state', lambda state: self._seen.states.append(state), _EVERY
        )
        self._events = self.create_subscription(
            EpisodeEvent, 'episode', lambda event: self._seen.events.append(event), _EVERY
        )
        self._reports = self.create_subscription(
            AdaptationReport,
            'adaptation',
            lambda report: self._seen.reports.append(report),
            _EVERY,
        )

    def wait_until_ready(self, timeout_s: float = 30.0) -> None:
        """Wait until the three nodes hear each other and this program."""
        for found, what in (
            (self._set_task.service_is_ready, 'service set_task'),
            (self._goal_is_heard, 'a subscriber of goal_pose'),
            (partial(self.count_subscribers, 'action'), 'a subscriber of action'),
            (partial(self.count_subscribers, 'goal'), 'a subscriber of goal'),
            (self._reports.get_publisher_count, 'a publisher of adaptation'),
            (
                lambda: self._events.get_publisher_count() >= 2,
                'simulator and goal node on episode',
            ),
        ):
            self.wait(found, what, timeout_s)

    def _goal_is_heard(self) -> bool:
        """True if every subscriber of goal_pose is matched, and one is not the recorder."""
        readers = self.get_subscriptions_info_by_topic(self._goal_pose.topic_name)
        matched = self._goal_pose.get_subscription_count()
        return matched >= len(readers) and any(r.node_name != 'recorder_node' for r in readers)

    def drive(
        self, task_id: int, seed: int, timeout_s: float = 60.0, *, as_task: bool = False
    ) -> GoalOutcome:
        """Put the robot at a task's start, give it the goal and watch what becomes of it.

        Args:
            task_id: The evaluation task.
            seed: Of the start, the goal and the adaptation.
            timeout_s: Longest wait for anything, seconds.
            as_task: Let the simulator announce the task's goal observation, as in an evaluation,
                instead of publishing the goal's position on `goal_pose`.
        """
        self._seen = _Watched()
        answer = self.set_task(task_id, seed, send_goal=as_task, timeout_s=timeout_s)
        if not answer.success:
            raise NoAnswerError(f'set_task {task_id} was refused: {answer.message}')
        if as_task:
            accepted = self._await_task_goal(answer.episode_id, timeout_s)
        else:
            accepted = self._publish_goal(answer, timeout_s)
        ends = (EpisodeEvent.REACHED, EpisodeEvent.TIMED_OUT, EpisodeEvent.ENDED)
        find_end = partial(self._events_of, accepted.query_id, ends)
        self.wait(lambda: bool(find_end()), 'the goal', timeout_s)
        end = find_end()[0]
        self.wait(
            lambda: any(report.query_id == accepted.query_id for report in self._seen.reports),
            'the adaptation report',
            timeout_s,
        )
        self.wait(
            lambda: any(s.step >= end.step for s in self._states(answer.episode_id)),
            'the last state',
            timeout_s,
        )
        states = [s for s in self._states(answer.episode_id) if s.step <= end.step]
        return GoalOutcome(
            success=end.kind == EpisodeEvent.REACHED,
            steps=end.step - accepted.step,
            path=[(s.position.x, s.position.y) for s in states],
            observations=[s.observation for s in states],
            goal=(answer.goal_position.x, answer.goal_position.y),
            report=next(r for r in self._seen.reports if r.query_id == accepted.query_id),
        )

    def _await_task_goal(self, episode_id: int, timeout_s: float) -> EpisodeEvent:
        """Wait for what the goal node makes of the goal that the simulator announced."""

        def answers() -> list[EpisodeEvent]:
            return [event for event in self._answers() if event.episode_id == episode_id]

        self.wait(lambda: bool(answers()), "the task's goal", timeout_s)
        event = answers()[0]
        if event.kind == EpisodeEvent.GOAL_REJECTED:
            raise NoAnswerError(f'the goal was rejected: {event.reason}')
        return event

    def _publish_goal(self, task: SetTask.Response, timeout_s: float) -> EpisodeEvent:
        """Publish the goal until the goal node accepts it in the new episode."""
        deadline = time.monotonic() + timeout_s
        while True:
            pose = PoseStamped()
            pose.header.frame_id = 'map'
            pose.header.stamp = self.get_clock().now().to_msg()
            pose.pose.position = task.goal_position
            pose.pose.orientation.w = 1.0
            self._goal_pose.publish(pose)
            since = Time.from_msg(pose.header.stamp)
            answers = partial(self._answers, since)
            self.wait(answers, 'goal_pose', timeout_s)
            event = answers()[0]
            if event.episode_id == task.episode_id:
                if event.kind == EpisodeEvent.GOAL_REJECTED:
                    raise NoAnswerError(f'the goal was rejected: {event.reason}')
                return event
            # The goal node has not seen the new episode's first state yet.
            if time.monotonic() > deadline:
                raise NoAnswerError('the goal node does not see the new episode')

    def _states(self, episode_id: int) -> list[MazeState]:
        return [state for state in self._seen.states if state.episode_id == episode_id]

    def _answers(self, since: Time | None = None) -> list[EpisodeEvent]:
        """Acceptances and rejections of goals that the goal node sent since a time.

        The goal node repeats its last events to whoever joins, some of them after the join.
        """
        kinds = (EpisodeEvent.GOAL_ACCEPTED, EpisodeEvent.GOAL_REJECTED)
        return [
            event
            for event in self._seen.events
            if event.kind in kinds
            and (since is None or Time.from_msg(event.header.stamp) >= since)
        ]

    def _events_of(self, query_id: int, kinds: tuple[int, ...]) -> list[EpisodeEvent]:
        return [e for e in self._seen.events if e.query_id == query_id and e.kind in kinds]
