"""Faults among real processes: killed and restarted nodes, goals under load, clean ends."""

from collections.abc import Callable
from itertools import count
from pathlib import Path
import signal

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from metagcttt.commander import GoalLostError, NoAnswerError, RobotCommander
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import GoalQuery, MazeState
from metagcttt_tools.benchmarks.restarts import drive
from metagcttt_tools.graph.process import NodeProcess
import numpy as np
import pytest

from tests.ros.graph import ANY, goal_pose, Graph, Record, RELIABLE

pytestmark = [pytest.mark.slow, pytest.mark.mujoco]

GOAL = (20.0, 20.0)
# Generous, for machines with more work than cores; `metagcttt benchmark restarts` measures.
PATIENCE_S = 60.0


class Robot:
    """The three nodes as processes, in realtime, and a program that uses them."""

    def __init__(
        self, graph: Graph, start: Callable[..., NodeProcess], dataset: Path, checkpoint: Path
    ) -> None:
        self.graph = graph
        self._start = start
        self._parameters = {
            'sim_bridge_node': {'speed_factor': 5.0, 'diagnostics_period_s': 0.1},
            'goal_node': {'dataset': dataset, 'max_steps': 1000000},
            'policy_node': {
                'dataset': dataset,
                'checkpoint': checkpoint,
                'adapt_steps': 5,
                'adapt_batch_size': 32,
                'diagnostics_period_s': 0.1,
            },
        }
        self.record = Record(graph, ANY)
        self.diagnostics = graph.collect(DiagnosticArray, '/diagnostics', RELIABLE)
        self.nodes: dict[str, NodeProcess] = {}
        self.commander = RobotCommander(context=graph.context, executor=graph._executor)

    def start(self, *names: str, **parameters) -> None:
        for name in names or self._parameters:
            given = {**self._parameters[name], **parameters}
            self.nodes[name] = self._start(name, **given)

    def diagnosed(self, node: str, message: str) -> None:
        self.diagnostics.clear()
        self.graph.wait(
            lambda: any(
                status.name == node and message in status.message
                for array in self.diagnostics
                for status in array.status
            ),
            f'{node}: {message}',
            timeout_s=PATIENCE_S,
        )


@pytest.fixture
def robot(graph: Graph, start_process, dataset_file: Path, checkpoint_folder: Path):
    robot = Robot(graph, start_process, dataset_file, checkpoint_folder)
    yield robot
    robot.commander.destroy_node()


@pytest.mark.parametrize(
    ('name', 'sim_time'),
    [
        ('sim_bridge_node', False),
        ('sim_bridge_node', True),
        ('goal_node', False),
        ('policy_node', False),
    ],
)
def test_killed_node_resumes_its_service_after_a_restart(
    robot: Robot, name: str, sim_time: bool
) -> None:
    clock = {'use_sim_time': sim_time}
    robot.start('sim_bridge_node')
    robot.start('goal_node', 'policy_node', **clock)
    drive(robot.commander, PATIENCE_S)
    sent = robot.commander.send(GOAL)
    robot.nodes[name].kill()
    if name == 'policy_node':
        robot.diagnosed('/sim_bridge_node', 'the action is zero: none was received recently')
    if name == 'sim_bridge_node':
        robot.diagnosed('/policy_node', 'the action is zero: no state for')
    if name == 'goal_node':
        robot.diagnosed('/policy_node', 'was not repeated for 2 s and is dropped')
        with pytest.raises(GoalLostError, match='the goal node is gone'):
            sent.result(timeout_s=PATIENCE_S)
    robot.start(name, **({} if name == 'sim_bridge_node' else clock))
    drive(robot.commander, PATIENCE_S)


def test_request_to_a_node_that_was_killed_is_an_error_in_time(robot: Robot) -> None:
    robot.start('sim_bridge_node', 'goal_node')
    robot.commander.set_task(1, timeout_s=PATIENCE_S)
    robot.graph.wait(robot.commander._reach_goal.server_is_ready, 'the goal node')
    for name in ('sim_bridge_node', 'goal_node'):
        robot.nodes[name].kill()
    with pytest.raises(NoAnswerError, match=r'no answer within 1 s: .*set_task'):
        robot.commander.set_task(1, timeout_s=1.0)
    with pytest.raises(NoAnswerError, match=r'no answer within 1 s: .*goal'):
        robot.commander.send(GOAL, timeout_s=1.0)


def test_goal_that_changes_every_100_ms_ends_well(robot: Robot) -> None:
    robot.start('sim_bridge_node', 'goal_node')
    robot.start('policy_node', adapt_steps=2000)
    robot.graph.wait(lambda: robot.record.actions, 'the first action', timeout_s=PATIENCE_S)
    robot.graph.publish('goal_pose', goal_pose(4.0, 0.0))
    robot.graph.wait(lambda: robot.record.actions[-1].query_id, 'an action towards a goal')
    for xy in [(0.0, 4.0), (4.0, 0.0)] * 15:
        robot.graph.publish('goal_pose', goal_pose(*xy))
        robot.graph.wait_for(0.1)
    robot.graph.publish('goal_pose', goal_pose(*GOAL))
    robot.nodes['policy_node'].check()

    def accepted() -> list[GoalQuery]:
        return [query for query in robot.record.queries if query.active]

    robot.graph.wait(lambda: accepted()[-1].position.y == GOAL[1], 'the last goal')
    last = accepted()[-1].query_id
    robot.graph.wait(
        lambda: robot.record.actions[-1].query_id == last, 'an action towards the last goal'
    )
    superseded = {query.query_id for query in accepted()} - {last}
    robot.graph.wait(
        lambda: superseded <= {report.query_id for report in robot.record.reports},
        'a report on every superseded goal',
    )
    assert all(np.isfinite(action.values).all() for action in robot.record.actions)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM], ids=['ctrl-c', 'sigterm'])
def test_policy_ends_cleanly_while_it_adapts(robot: Robot, number: int) -> None:
    robot.start('sim_bridge_node', 'goal_node')
    robot.start('policy_node', adapt_steps=10000, adapt_batch_size=1024)
    robot.graph.wait(lambda: robot.record.actions, 'the first action', timeout_s=PATIENCE_S)
    robot.commander.set_task(1)
    sent = robot.commander.send(GOAL)
    robot.graph.wait(
        lambda: sent.feedback and sent.feedback.phase == ReachGoal.Feedback.ADAPTING,
        'the adaptation',
        timeout_s=PATIENCE_S,
    )
    for name in ('policy_node', 'goal_node', 'sim_bridge_node'):
        assert robot.nodes[name].stop(timeout_s=PATIENCE_S, signal_number=number) == 0


def test_second_policy_process_stands_still_until_it_is_alone(robot: Robot) -> None:
    robot.start()
    drive(robot.commander, PATIENCE_S)
    first = robot.nodes['policy_node']
    robot.start('policy_node')
    robot.diagnosed('/policy_node', 'another policy node acts in this graph')
    robot.record.actions.clear()

    def stands_still() -> bool:
        newest = [any(action.values) for action in robot.record.actions[-4:]]
        return len(newest) == 4 and not any(newest)

    robot.graph.wait(stands_still, 'zero actions')
    first.stop(signal_number=signal.SIGKILL)
    drive(robot.commander, PATIENCE_S)


def test_control_period_holds_while_adapting(
    graph: Graph, start_process, dataset_file: Path, checkpoint_folder: Path
) -> None:
    start_process('goal_node', dataset=dataset_file)
    start_process(
        'policy_node',
        dataset=dataset_file,
        checkpoint=checkpoint_folder,
        adapt_steps=10000,
        adapt_batch_size=10000,  # minutes, for any machine
    )
    record = Record(graph, ANY)
    states = graph.node.create_publisher(MazeState, 'state', ANY)
    commander = RobotCommander(context=graph.context, executor=graph._executor)
    graph.wait(lambda: states.get_subscription_count() >= 3, 'the nodes', timeout_s=PATIENCE_S)
    diagnostics = graph.collect(DiagnosticArray, '/diagnostics', RELIABLE)
    while not record.actions:  # the first may be lost while the nodes still find each other
        states.publish(MazeState(episode_id=1, observation=[0.0, 0.0]))
        graph.wait_for(0.02)
    sent = commander.send(GOAL)
    assert sent.accepted, sent.result()
    steps = count(1)

    def answered_while_adapting() -> bool:
        states.publish(MazeState(episode_id=1, step=next(steps), observation=[0.0, 0.0]))
        graph.wait_for(0.02)
        answered = {action.step for action in record.actions}
        adapting = sent.feedback and sent.feedback.phase == ReachGoal.Feedback.ADAPTING
        return adapting and len(answered) > 50

    # A policy that waits for its expert answers none.
    graph.wait(answered_while_adapting, 'more than 50 answers', timeout_s=PATIENCE_S)

    def warning() -> DiagnosticStatus | None:
        statuses = [status for array in diagnostics for status in array.status]
        newest = next((s for s in reversed(statuses) if s.name == '/policy_node'), None)
        return newest if newest and newest.level == DiagnosticStatus.WARN else None

    status = graph.wait(warning, 'a warning of the policy')
    print({pair.key: pair.value for pair in status.values})
    commander.destroy_node()
