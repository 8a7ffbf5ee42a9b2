"""Every parameter that may change while a node runs changes what the node does."""

from collections.abc import Callable
from pathlib import Path
import re

from metagcttt.parameters import TABLES
from metagcttt.sim.node import SimBridgeNode
from metagcttt_core import kernels, make_agent, save_checkpoint
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import ActionCommand, MazeState
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
import torch
import yaml

from tests.ros.fault_rig import FaultRig, WARN
from tests.ros.goal_rig import FREE, GoalRig
from tests.ros.graph import ANY, Graph, RELIABLE
from tests.ros.policy_rig import PolicyRig


def change(node: Node, **values) -> None:
    for name, value in values.items():
        [result] = node.set_parameters([Parameter(name, value=value)])
        assert result.successful, result.reason


def test_no_parameter_is_left_out() -> None:
    sources = ''.join(
        path.read_text(encoding='utf-8') for path in Path(__file__).parent.rglob('test_*.py')
    )
    for node, table in TABLES.items():
        for parameter in table:
            if parameter.changes == 'now':
                given = rf"(set|change)\([^)]*\b{parameter.name}=|\(\s*'{parameter.name}', "
                assert re.search(given, sources), f'{node}: {parameter.name}'


def test_choices_are_words_in_parameter_files() -> None:
    choices = [choice for table in TABLES.values() for each in table for choice in each.choices]
    assert [yaml.safe_load(choice) for choice in choices] == choices  # `off` would be false


@pytest.fixture
def critic_files(tmp_path: Path, dataset_file: Path) -> dict[str, str]:
    agent = make_agent('gciql', obs_dim=2, act_dim=2, hidden=(16, 16))
    agent.optimizer_state = {
        number: {
            'step': torch.tensor(100.0),
            'exp_avg': torch.full_like(weight, 0.01),
            'exp_avg_sq': torch.full_like(weight, 0.01),
        }
        for number, weight in enumerate(agent.trained_parameters())
    }
    save_checkpoint(agent, tmp_path / 'gciql')
    return {'checkpoint': str(tmp_path / 'gciql'), 'dataset': str(dataset_file)}


@pytest.mark.parametrize(
    ('name', 'value', 'shown_by'),
    [
        ('adapt_steps', 5, 'steps'),
        ('adapt_lr', 0.03, 'train_losses'),
        ('adapt_batch_size', 16, 'train_losses'),
        ('actor_only', True, 'train_losses'),
        ('engine', 'eager', 'train_losses'),
        ('precision', 'bfloat16', 'train_losses'),
        ('optimizer_state', 'pretrained', 'train_losses'),
        ('early_stopping', False, 'test_losses'),
        ('test_fraction', 0.5, 'test_losses'),
    ],
)
def test_next_adaptation_is_another_one(
    graph: Graph, critic_files: dict[str, str], name: str, value: float, shown_by: str
) -> None:
    rig = PolicyRig(graph, critic_files, early_stopping=True)
    rig.state()
    rig.goal(1)
    first = rig.report(1)
    rig.goal(2)
    assert getattr(rig.report(2), shown_by) == getattr(first, shown_by)
    change(rig.node, **{name: value})
    rig.goal(3)
    assert getattr(rig.report(3), shown_by) != getattr(first, shown_by)


def test_optimizer_state_that_the_checkpoint_lacks_is_refused(
    graph: Graph, tmp_path: Path, dataset_file: Path
) -> None:
    save_checkpoint(make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(16,)), tmp_path / 'bare')
    rig = PolicyRig(graph, {'checkpoint': str(tmp_path / 'bare'), 'dataset': str(dataset_file)})
    [result] = rig.node.set_parameters([Parameter('optimizer_state', value='pretrained')])
    assert not result.successful
    assert 'bare: has no optimiser state of pre-training' in result.reason
    assert rig.node.get_parameter('optimizer_state').value == 'fresh'


def test_engine_without_a_compiler(
    graph: Graph, checkpoint_folder: Path, dataset_file: Path, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    monkeypatch.setenv('CC', 'no-such-compiler')
    kernels._find.cache_clear()
    monkeypatch.setattr(kernels, '_find', kernels._find.__wrapped__)
    rig = PolicyRig(graph, {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)})
    rig.state()
    rig.goal(1)
    assert rig.report(1).accepted
    assert rig.session.examine().values['adapt_engine'] == 'analytic'
    [result] = rig.node.set_parameters([Parameter('engine', value='kernels')])
    assert 'engine kernels: no-such-compiler: ' in result.reason
    assert rig.node.get_parameter('engine').value == 'auto'


def test_next_goal_is_adapted_to_anew_after_the_horizon(
    graph: Graph, critic_files: dict[str, str]
) -> None:
    rig = PolicyRig(graph, critic_files, adaptation='hold')
    change(rig.node, horizon=1)
    rig.goal()
    for step in range(3):
        rig.state(step=step)
        rig.action_for(step)
    rig.graph.wait(lambda: len(rig.record.reports) == 3, 'three reports')


def test_next_goal_is_waited_for(
    graph: Graph, critic_files: dict[str, str], slow_adaptation
) -> None:
    rig = PolicyRig(graph, critic_files, adaptation='async')
    rig.state()
    rig.goal(1)
    assert not rig.action_for(0).adapted
    change(rig.node, adaptation='hold')
    rig.goal(2)
    rig.graph.wait(lambda: rig.session._pursuit.goal.query_id == 2, 'the second goal')
    rig.wait_until_adapting()
    rig.state(step=1)
    rig.graph.wait(lambda: rig.session._state.step == 1, 'the state')
    slow_adaptation.set()
    assert rig.action_for(1).adapted


@pytest.fixture
def driving(graph: Graph, critic_files: dict[str, str]) -> FaultRig:
    rig = FaultRig(graph, critic_files, state_timeout_s=3600.0)
    rig.goal()
    rig.drive()
    return rig


def test_state_gets_too_old_for_the_policy(driving: FaultRig) -> None:
    change(driving.node, state_timeout_s=0.1)
    driving.wait_for_zero()


@pytest.mark.parametrize(
    ('name', 'value', 'message'),
    [
        ('warn_latency_ms', 0.0, '99 % of actions within'),
        ('warn_adapt_ms', 0.0, 'the adaptation took'),
    ],
)
def test_diagnostics_warn(driving: FaultRig, name: str, value: float, message: str) -> None:
    change(driving.node, **{name: value})
    driving.diagnosed(WARN, message)


def test_diagnostics_warn_of_missed_deadlines(driving: FaultRig) -> None:
    change(driving.node, rate_hz=1000.0)  # faster than the node can be spun here
    change(driving.node, warn_missed_deadlines=0)
    driving.diagnosed(WARN, 'deadlines missed in the last minute')


@pytest.fixture
def make_goal_rig(graph: Graph, dataset_file: Path):
    rigs = []

    def make(**parameters) -> GoalRig:
        rigs.append(GoalRig(graph, dataset_file, **parameters))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.commander.destroy_node()


def test_next_goal_has_the_seed(make_goal_rig: Callable[..., GoalRig]) -> None:
    rig = make_goal_rig()
    rig.state()
    rig.commander.send(FREE)
    change(rig.node, seed=41)
    rig.commander.send(FREE)
    rig.graph.wait(lambda: len(rig.record.queries) == 2, 'both goals')
    assert [query.seed for query in rig.record.queries] == [0, 41]


def test_goal_under_way_is_reached_from_farther(make_goal_rig: Callable[..., GoalRig]) -> None:
    rig = make_goal_rig(goal_tolerance_m=0.1)
    rig.state()
    sent = rig.commander.send(FREE)
    rig.state(x=3.5, step=1)
    assert not sent.is_done()
    change(rig.node, goal_tolerance_m=1.0)
    rig.state(x=3.5, step=2)
    assert sent.result().success


def test_goal_under_way_has_fewer_steps(make_goal_rig: Callable[..., GoalRig]) -> None:
    rig = make_goal_rig()
    rig.state()
    sent = rig.commander.send(FREE)
    rig.state(step=5)
    assert not sent.is_done()
    change(rig.node, max_steps=6)
    rig.state(step=6)
    assert sent.result().error_code == ReachGoal.Result.TIMED_OUT


def test_silence_of_the_simulator_ends_the_goal(make_goal_rig: Callable[..., GoalRig]) -> None:
    rig = make_goal_rig(stepping='realtime', state_timeout_s=3600.0)
    rig.state()
    sent = rig.commander.send(FREE)
    change(rig.node, state_timeout_s=0.2)
    assert sent.result(30).error_code == ReachGoal.Result.STATE_LOST


def test_silence_of_the_policy_ends_the_goal_in_lockstep(
    make_goal_rig: Callable[..., GoalRig],
) -> None:
    rig = make_goal_rig(partner_timeout_s=3600.0)
    rig.state()
    sent = rig.commander.send(FREE)
    change(rig.node, partner_timeout_s=0.2)
    assert sent.result(30).error_code == ReachGoal.Result.POLICY_LOST


def test_silence_of_the_policy_is_diagnosed(make_goal_rig: Callable[..., GoalRig]) -> None:
    rig = make_goal_rig(policy_timeout_s=3600.0)
    rig.state()
    rig.policy()
    rig.commander.send(FREE)
    rig.graph.wait(lambda: rig.node._examine().message == 'goal 1 in force', 'the goal')
    change(rig.node, policy_timeout_s=0.1)
    rig.graph.wait(
        lambda: 'no policy status is received' in rig.node._examine().message, 'the warning'
    )


@pytest.mark.mujoco
def test_action_gets_too_old_for_the_simulator(graph: Graph) -> None:
    node = graph.add(SimBridgeNode, speed_factor=10.0, action_timeout_s=3600.0)
    states: list[MazeState] = graph.collect(MazeState, 'state', ANY)
    actions = graph.node.create_publisher(ActionCommand, 'action', RELIABLE)
    graph.wait(lambda: states and actions.get_subscription_count(), 'the simulator')
    actions.publish(ActionCommand(episode_id=1, values=[1.0, 0.0]))
    age = 'the action is zero: none was received recently'
    graph.wait(lambda: node._action.any(), 'the action')
    graph.wait_for(0.3)
    assert node._examine().message != age
    change(node, action_timeout_s=0.01)
    graph.wait(lambda: node._examine().message == age, 'the zero action')
