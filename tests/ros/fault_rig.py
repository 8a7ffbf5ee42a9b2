"""A policy in realtime and what the graph says of it; the test plays the others."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from metagcttt.converters import to_time
from metagcttt.policy.node import PolicyNode
from metagcttt_interfaces.msg import GoalQuery, MazeState
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from tests.ros.graph import EVERY, Graph, Record, RELIABLE

GOAL = (20.0, 20.0)
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class FaultRig:
    """A policy in realtime; the test plays the simulator and the goal node."""

    def __init__(self, graph: Graph, files: dict[str, str], **parameters) -> None:
        self.graph = graph
        defaults = {
            'adapt_steps': 2,
            'adapt_batch_size': 16,
            'rate_hz': 50.0,
            # So long that a busy machine does not turn another fault into this one.
            'state_timeout_s': 5.0,
            'diagnostics_period_s': 0.05,
            # Of what is measured here, some depends on the machine.
            'warn_latency_ms': 10000.0,
            'warn_missed_deadlines': 10**6,
        }
        self._parameters = {**defaults, **files, **parameters}
        self.node = graph.add(PolicyNode, **self._parameters)
        self.record = Record(graph)
        self.diagnostics = graph.collect(DiagnosticArray, '/diagnostics', RELIABLE)
        self._states = graph.node.create_publisher(MazeState, 'state', EVERY)
        self._goals = graph.node.create_publisher(GoalQuery, 'goal', EVERY)
        self._step = 0
        self._clock: Publisher | None = None

    def another_policy(self) -> Node:
        return self.graph.add(PolicyNode, **self._parameters)

    def state(self, observation=(0.0, 0.0), step: int | None = None, episode_id: int = 1) -> None:
        self._step += step is None
        step = self._step if step is None else step
        if self._clock is not None:
            self._clock.publish(Clock(clock=to_time(step * 10**8)))
        self._states.publish(
            MazeState(episode_id=episode_id, step=step, observation=list(observation))
        )

    def answered_state(self) -> None:
        """The next state, and wait for the action that moves the robot in it."""
        self.state()
        self.graph.wait(
            lambda: any(a.step == self._step and any(a.values) for a in self.record.actions),
            'an action for the state',
        )

    def goal(self, query_id: int = 1, goal=GOAL, episode_id: int = 1, **fields) -> None:
        self._goals.publish(
            GoalQuery(
                query_id=query_id, episode_id=episode_id, active=True, goal=list(goal), **fields
            )
        )

    def play_clock(self) -> None:
        """Let simulated time go on by 0.1 s with every new state."""
        self._clock = self.graph.node.create_publisher(Clock, '/clock', EVERY)
        self.graph.wait(self._clock.get_subscription_count, 'who follows the clock')

    def drive(self) -> None:
        """Wait until the robot moves, with fresh states."""
        self.record.actions.clear()

        def moves() -> bool:
            self.state()
            return any(any(action.values) for action in self.record.actions)

        self.graph.wait(moves, 'an action that moves the robot')

    def wait_for_zero(self) -> None:
        self.record.actions.clear()
        self.graph.wait(
            lambda: self.record.actions and not any(self.record.actions[-1].values),
            'a zero action',
        )

    def diagnosed(self, level: bytes, message: str, node: str = '/policy_node', fresh=True):
        """Wait for a diagnostic, while states go on unless they are not to be `fresh`."""
        self.diagnostics.clear()

        def found():
            if fresh and self._states is not None:
                self.state()
            for array in self.diagnostics:
                for status in array.status:
                    if (status.name, status.level) == (node, level) and message in status.message:
                        return status
            return None

        return self.graph.wait(found, f'{node}: {level} {message}')


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}
