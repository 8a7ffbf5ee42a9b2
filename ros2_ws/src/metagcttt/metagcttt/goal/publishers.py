"""Publishers of the goal node, and its log of goals."""

import math
import time

from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent, GoalQuery
from rclpy.node import Node
from std_msgs.msg import Header

from metagcttt.converters import goal_message, to_point
from metagcttt.goal.goals import AcceptedGoal
from metagcttt.goal.tracker import (
    Accepted,
    Change,
    Ended,
    GoalRequest,
    MAX_REQUEST_ID,
    Rejected,
)
from metagcttt.goal.verdict import Verdict
from metagcttt.goal_in_force import Goal
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
        """Create the publishers.

        Args:
            node: The node to publish through.
            frame_id: Frame of all positions.
        """
        self._node = node
        self._frame_id = frame_id
        self._goal = GoalQuery()
        self._goal_s = 0.0
        self._goals = node.create_publisher(GoalQuery, 'goal', LATCHED)
        self._events = node.create_publisher(EpisodeEvent, 'episode', EVENTS)

    def publish(self, change: Change, lease_s: float) -> None:
        """Publish and log a change.

        Args:
            change: The change.
            lease_s: Seconds after which the policy drops a goal that is not repeated; 0: never.
        """
        match change:
            case Accepted(goal):
                self._set_goal(goal, active=True, lease_s=lease_s)
                fields = {'kind': EpisodeEvent.GOAL_ACCEPTED, 'step': goal.first_step}
                self._announce('accepted', goal, Verdict('NONE', ''), **fields)
            case Ended(goal, verdict, step):
                if verdict.error != 'PREEMPTED':  # a newer goal follows
                    self._set_goal(goal, active=False)
                kind, what = ENDINGS.get(verdict.error, ENDED)
                self._announce(what, goal, verdict, kind=kind, step=step)
            case Rejected(request, verdict, moment):
                fields = {'kind': EpisodeEvent.GOAL_REJECTED, **moment._asdict()}
                self._announce('rejected', request, verdict, **fields)

    def repeat_goal(self, now_s: float) -> None:
        """Publish the newest goal again, unchanged, when that is due."""
        lease_s = self._goal.lease_s
        if lease_s > 0 and now_s - self._goal_s >= lease_s / REPEATS_PER_LEASE:
            self._publish_goal(now_s)

    def _set_goal(self, goal: Goal, *, active: bool, lease_s: float = 0.0) -> None:
        self._goal = goal_message(self._header(), goal, active=active, lease_s=lease_s)
        self._publish_goal(time.monotonic())

    def _publish_goal(self, now_s: float) -> None:
        self._goal_s = now_s
        self._goals.publish(self._goal)

    def _announce(
        self, what: str, goal: AcceptedGoal | GoalRequest, verdict: Verdict, **fields: int
    ) -> None:
        name, (x, y) = 'goal', goal.xy
        if isinstance(goal, AcceptedGoal):
            name = f'goal {goal.query_id}'
            fields |= {'query_id': goal.query_id, 'episode_id': goal.episode_id}
            fields['world_id'] = goal.world_id
        self._events.publish(
            EpisodeEvent(
                header=self._header(),
                reason=verdict.reason,
                error_code=getattr(ReachGoal.Result, verdict.error),
                request_id=goal.request_id[:MAX_REQUEST_ID],
                position=to_point(goal.xy),
                **fields,
            )
        )
        reason = f': {verdict.reason}' if verdict.reason else ''
        place = '' if math.isnan(x) else f' at ({x:.2f}, {y:.2f})'  # a robot without a position
        self._node.get_logger().info(f'{name}{place} {what}{reason}')

    def _header(self) -> Header:
        return Header(stamp=self._node.get_clock().now().to_msg(), frame_id=self._frame_id)
