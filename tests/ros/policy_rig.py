"""A policy node whose simulator and goal node the test plays."""

from metagcttt.policy.node import PolicyNode
from metagcttt_core import load_checkpoint
from metagcttt_interfaces.msg import GoalQuery, MazeState
from rclpy.parameter import Parameter

from tests.ros.graph import EVERY, Graph, Record

ON_THE_WAY = (0.0, 0.0)  # start of task 1, where the dataset's walks begin
TASK_1_GOAL = (20.0, 20.0)


class PolicyRig:
    """A policy node, and a simulator and a goal node that the test plays."""

    def __init__(self, graph: Graph, files: dict[str, str], **parameters) -> None:
        self.graph = graph
        defaults = {'adapt_steps': 3, 'adapt_batch_size': 32, 'stepping': 'lockstep', **files}
        self.node = graph.add(PolicyNode, **{**defaults, **parameters})
        self.base = load_checkpoint(files['checkpoint'])
        self.record = Record(graph, EVERY)
        self._states = graph.node.create_publisher(MazeState, 'state', EVERY)
        self._goals = graph.node.create_publisher(GoalQuery, 'goal', EVERY)

    @property
    def session(self):
        return self.node._session

    def state(self, xy=ON_THE_WAY, step: int = 0, episode_id: int = 1, **flags) -> None:
        self._states.publish(
            MazeState(episode_id=episode_id, step=step, observation=list(xy), **flags)
        )

    def goal(self, query_id: int = 1, goal=TASK_1_GOAL, episode_id: int = 1, **fields) -> None:
        fields = {'active': True, **fields}
        self._goals.publish(
            GoalQuery(query_id=query_id, episode_id=episode_id, goal=list(goal), **fields)
        )

    def wait_until_adapting(self) -> None:
        self.graph.wait(
            lambda: self.session._pursuit and self.session._pursuit.adapting, 'an adaptation'
        )

    def report(self, query_id: int = 1):
        return self.graph.wait(
            lambda: next((r for r in self.record.reports if r.query_id == query_id), None),
            f'the report on query {query_id}',
        )

    def action(self, accept=lambda action: True):
        return self.graph.wait(
            lambda: next((action for action in self.record.actions if accept(action)), None),
            'an action',
        )

    def action_for(self, step: int):
        return self.action(lambda action: action.step == step)

    def set(self, **values):
        """Set parameters; the reason of a refusal, empty when they were taken."""
        results = self.node.set_parameters(
            [Parameter(name, value=value) for name, value in values.items()]
        )
        return ''.join(result.reason for result in results if not result.successful)
