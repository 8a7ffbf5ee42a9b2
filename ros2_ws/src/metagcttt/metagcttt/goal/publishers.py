"""What the goal node publishes and logs about goals."""

import time

from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent, GoalQuery, MazeState
from rclpy.node import Node
from std_msgs.msg import Header

from metagcttt.converters import to_floats, to_point
from metagcttt.goal.goals import Goal, Verdict
from metagcttt.qos import EVENTS, LATCHED

ENDINGS = {
    'NONE': (EpisodeEvent.REACHED, 'reached'),
    'TIMED_OUT': (EpisodeEvent.TIMED_OUT, 'timed out'),
    'EPISODE_ENDED': (EpisodeEvent.TIMED_OUT, 'timed out'),
}
ENDED = (EpisodeEvent.ENDED, 'ended')
REPEATS_PER_LEASE = 4


class GoalPublishers:
    """Publishes `goal` and the goals' part of `episode`."""

    def __init__(self, node: Node, frame_id: str) -> None:
        """Connect.

        Args:
            node: The node to publish through.
            frame_id: Frame of all positions.
        """
        self._node = node
        self._frame_id = frame_id
        self._query = GoalQuery()
        self._query_s = 0.0
        self._queries = node.create_publisher(GoalQuery, 'goal', LATCHED)
        self._events = node.create_publisher(EpisodeEvent, 'episode', EVENTS)

    def query(self, goal: Goal, *, active: bool, lease_s: float = 0.0) -> None:
        """Tell the policy to act on a goal, or that it is over.

        Args:
            goal: The goal.
            active: Whether to act on it.
            lease_s: Seconds after which the policy drops a goal that is not kept up; 0: never.
        """
        self._query = GoalQuery(
            header=self._header(),
            query_id=goal.query_id,
            episode_id=goal.episode_id,
            active=active,
            goal=to_floats(goal.observation),
            position=to_point(goal.xy),
            seed=goal.seed,
            lease_s=lease_s,
        )
        self._publish_query(time.monotonic())

    def keep_up(self, now_s: float) -> None:
        """Repeat the newest query when it is time to; it goes out as it was."""
        lease_s = self._query.lease_s
        if lease_s > 0 and now_s - self._query_s >= lease_s / REPEATS_PER_LEASE:
            self._publish_query(now_s)

    def _publish_query(self, now_s: float) -> None:
        self._query_s = now_s
        self._queries.publish(self._query)

    def accepted(self, goal: Goal) -> None:
        """A goal was numbered."""
        self._publish(EpisodeEvent.GOAL_ACCEPTED, goal, goal.first_step)
        self._log(f'goal {goal.query_id}', goal.xy, 'accepted', '')

    def rejected(
        self,
        refusal: Verdict,
        xy: tuple[float, float],
        state: MazeState | None,
        request_id: str = '',
    ) -> None:
        """A goal at `xy` was refused in `state`."""
        self._events.publish(
            EpisodeEvent(
                header=self._header(),
                kind=EpisodeEvent.GOAL_REJECTED,
                episode_id=state.episode_id if state else 0,
                step=state.step if state else 0,
                reason=refusal.reason,
                error_code=getattr(ReachGoal.Result, refusal.error),
                request_id=request_id,
                position=to_point(xy),
            )
        )
        self._log('goal', xy, 'rejected', refusal.reason)

    def ended(self, goal: Goal, verdict: Verdict, step: int) -> None:
        """A goal is over since a control step of its episode."""
        kind, name = ENDINGS.get(verdict.error, ENDED)
        self._publish(kind, goal, step, verdict)
        self._log(f'goal {goal.query_id}', goal.xy, name, verdict.reason)

    def _publish(self, kind: int, goal: Goal, step: int, verdict: Verdict | None = None) -> None:
        self._events.publish(
            EpisodeEvent(
                header=self._header(),
                kind=kind,
                episode_id=goal.episode_id,
                query_id=goal.query_id,
                step=step,
                reason=verdict.reason if verdict else '',
                error_code=getattr(ReachGoal.Result, verdict.error) if verdict else 0,
                request_id=goal.request_id,
                position=to_point(goal.xy),
            )
        )

    def _header(self) -> Header:
        return Header(stamp=self._node.get_clock().now().to_msg(), frame_id=self._frame_id)

    def _log(self, goal: str, xy: tuple[float, float], what: str, reason: str) -> None:
        self._node.get_logger().info(
            f'{goal} at ({xy[0]:.2f}, {xy[1]:.2f}) {what}{": " if reason else ""}{reason}'
        )
