"""A goal node and its client; the test plays the simulator and the policy."""

from pathlib import Path

from metagcttt.commander import RobotCommander
from metagcttt.goal.node import GoalNode
from metagcttt_interfaces.msg import EpisodeEvent, MazeState, PolicyStatus

from tests.ros.graph import EVERY, Graph, Record

FREE = (4.0, 0.0)
ALSO_FREE = (0.0, 4.0)


class GoalRig:
    """A goal node and its client; the test plays the simulator and the policy."""

    def __init__(self, graph: Graph, dataset: Path, **parameters) -> None:
        self.graph = graph
        self.node = graph.add(
            GoalNode, **{'dataset': str(dataset), 'stepping': 'lockstep', **parameters}
        )
        self.record = Record(graph, EVERY)
        self.commander = RobotCommander(context=graph.context, executor=graph._executor)
        self._states = graph.node.create_publisher(MazeState, 'state', EVERY)
        self._events = graph.node.create_publisher(EpisodeEvent, 'episode', EVERY)
        self._policy = graph.node.create_publisher(PolicyStatus, 'policy_status', EVERY)
        graph.wait(
            lambda: (
                self._states.get_subscription_count() == 2
                and self._events.get_subscription_count() == 3
                and self._policy.get_subscription_count() == 1
            ),
            'the goal node',
        )

    def state(self, x: float = 0.0, y: float = 0.0, step: int = 0, episode_id: int = 1, **flags):
        message = MazeState(episode_id=episode_id, step=step, observation=[x, y], **flags)
        message.position.x, message.position.y = x, y
        known = len(self.record.states)
        self._states.publish(message)
        self.graph.wait(lambda: len(self.record.states) > known, 'the state')

    def started(self, episode_id: int) -> None:
        self._events.publish(EpisodeEvent(kind=EpisodeEvent.STARTED, episode_id=episode_id))

    def policy(self, **fields) -> None:
        self._policy.publish(PolicyStatus(**fields))

    def error(self, sent) -> tuple[int, str]:
        result = sent.result(10)
        assert not result.success
        return result.error_code, result.error_msg
