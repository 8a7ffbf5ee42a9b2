"""The client of demo and evaluation, beside a stand-in for the robot."""

from geometry_msgs.msg import Point, PoseStamped
from metagcttt.qos import EVENTS
from metagcttt_interfaces.msg import AdaptationReport, EpisodeEvent, MazeState
from metagcttt_interfaces.srv import SetTask
from metagcttt_tools.graph.client import MazeClient
import pytest
from rclpy.time import Time
from std_msgs.msg import Header

from tests.ros.graph import EVERY, Graph, RELIABLE

pytestmark = pytest.mark.ros

EPISODE, QUERY, STEPS = 7, 4, 5


class StandIn:
    """Answers `set_task`; takes a goal, repeats events of before and reports the goal reached."""

    def __init__(self, graph: Graph) -> None:
        self.node = graph.node
        self.poses: list[PoseStamped] = []
        self._events = self.node.create_publisher(EpisodeEvent, 'episode', EVENTS)
        self._reports = self.node.create_publisher(AdaptationReport, 'adaptation', EVERY)
        self._states = self.node.create_publisher(MazeState, 'state', EVERY)
        self.node.create_service(SetTask, 'set_task', self._set_task)
        self.node.create_subscription(PoseStamped, 'goal_pose', self._take, RELIABLE)

    def _set_task(self, _: SetTask.Request, response: SetTask.Response) -> SetTask.Response:
        response.success = True
        response.episode_id = EPISODE
        response.goal_position = Point(x=4.0, y=8.0)
        return response

    def _take(self, pose: PoseStamped) -> None:
        self.poses.append(pose)
        long_ago = Time(seconds=1000)
        for query in range(1, QUERY):
            self._say(EpisodeEvent.GOAL_ACCEPTED, long_ago, EPISODE - 1, query, 0)
        now = self.node.get_clock().now()
        self._say(EpisodeEvent.GOAL_ACCEPTED, now, EPISODE, QUERY, 0)
        self._reports.publish(AdaptationReport(query_id=QUERY))
        self._states.publish(MazeState(episode_id=EPISODE, step=STEPS))
        self._say(EpisodeEvent.REACHED, now, EPISODE, QUERY, STEPS)

    def _say(self, kind: int, at: Time, episode: int, query: int, step: int) -> None:
        self._events.publish(
            EpisodeEvent(
                header=Header(stamp=at.to_msg()),
                kind=kind,
                episode_id=episode,
                query_id=query,
                step=step,
            )
        )


def test_events_from_before_the_goal_are_no_answer_to_it(graph: Graph) -> None:
    robot = StandIn(graph)
    client = MazeClient(lambda: None, context=graph.context, executor=graph._executor)
    graph.wait(client._goal_pose.get_subscription_count, 'the stand-in')
    outcome = client.drive(task_id=1, seed=0)
    assert (outcome.success, outcome.steps, outcome.goal) == (True, STEPS, (4.0, 8.0))
    assert len(robot.poses) == 1
    client.destroy_node()
