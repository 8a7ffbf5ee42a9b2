from pathlib import Path

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from metagcttt.policy import node as policy_node
from metagcttt_core import make_agent, save_checkpoint, TrajectoryDataset
import numpy as np
import pytest
from tests.ros.graph import Graph
from tests.ros.policy_rig import PolicyRig


@pytest.fixture
def make_rig(graph: Graph, checkpoint_folder: Path, dataset_file: Path):
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    return lambda **parameters: PolicyRig(graph, files, **parameters)


# --- acting -----------------------------------------------------------------------------------


def test_lockstep_answers_every_state_exactly_once_and_only_with_a_goal(make_rig) -> None:
    rig = make_rig(adapt_steps=0)
    rig.state(step=5)
    rig.graph.wait(lambda: rig.session._state, 'the state')
    rig.goal(1)
    assert rig.action().step == 5
    rig.goal(2)
    rig.report(2)
    rig.state(step=6)
    rig.action_for(6)
    rig.goal(2, active=False)
    rig.state(step=7)
    rig.graph.wait(lambda: rig.session._state.step == 7, 'the state without a goal')
    rig.goal(3)
    rig.action_for(7)
    assert [a.step for a in rig.record.actions] == [5, 6, 7]


def test_realtime_publishes_at_its_rate_and_zero_without_a_goal(make_rig) -> None:
    rig = make_rig(stepping='realtime', rate_hz=100.0, state_timeout_s=30.0)
    rig.state(step=3)
    idle = rig.action()
    assert (list(idle.values), idle.query_id, idle.step) == ([0, 0], 0, 3)
    rig.goal()
    acting = rig.action(lambda action: action.adapted)
    assert any(acting.values)
    rig.goal(active=False)
    rig.graph.wait(
        lambda: not any(value for action in rig.record.actions[-3:] for value in action.values),
        'zero actions after the stop',
    )


@pytest.mark.parametrize('xy', [(float('nan'), 0.0), (1.0,), ()], ids=['nan', 'short', 'empty'])
@pytest.mark.parametrize('stepping', ['realtime', 'lockstep'])
def test_unusable_state_gets_a_zero_action(make_rig, xy, stepping: str) -> None:
    rig = make_rig(stepping=stepping)
    rig.goal()
    rig.state(xy=xy)
    action = rig.action_for(0)
    assert (list(action.values), action.adapted) == ([0, 0], False)
    rig.state(step=1)
    rig.action(lambda action: action.step == 1 and any(action.values))


def test_stale_state_gets_a_zero_action(make_rig) -> None:
    rig = make_rig(stepping='realtime', state_timeout_s=0.2, adapt_steps=0, rate_hz=100.0)
    rig.goal()
    rig.state()
    rig.action(lambda action: any(action.values))
    rig.graph.wait(lambda: not any(rig.record.actions[-1].values), 'the zero action')


@pytest.mark.parametrize('goal', [(1.0,), (float('inf'), 0.0)])
def test_unusable_goal_is_refused_and_reported(make_rig, goal) -> None:
    rig = make_rig()
    rig.state()
    rig.goal(goal=goal)
    assert 'the goal' in rig.report().reason
    rig.goal(2)
    assert rig.action().query_id == 2


def test_ended_episode_gets_no_answer(make_rig) -> None:
    rig = make_rig(adapt_steps=0)
    rig.goal()
    rig.state(step=4)
    rig.action_for(4)
    rig.state(step=5, terminated=True)
    rig.state(step=0, episode_id=2)
    rig.goal(2, episode_id=2)
    rig.action(lambda action: action.episode_id == 2)
    assert [a.step for a in rig.record.actions] == [4, 0]


# --- lifecycle --------------------------------------------------------------------------------


def change(rig: PolicyRig, transition: int) -> bool:
    request = ChangeState.Request()
    request.transition.id = transition
    return rig.graph.call(ChangeState, 'policy_node/change_state', request).success


def label(rig: PolicyRig) -> str:
    response = rig.graph.call(GetState, 'policy_node/get_state', GetState.Request())
    return response.current_state.label


def test_lifecycle_through_its_services(make_rig) -> None:
    rig = make_rig(autostart=False, adapt_steps=0)
    assert label(rig) == 'unconfigured'
    rig.state()
    rig.goal()
    assert change(rig, Transition.TRANSITION_CONFIGURE)
    rig.graph.wait(lambda: rig.session._state and rig.session._pursuit, 'state and goal')
    assert rig.record.actions == []
    assert change(rig, Transition.TRANSITION_ACTIVATE)
    rig.action_for(0)
    assert change(rig, Transition.TRANSITION_DEACTIVATE)
    rig.state(step=1)
    rig.graph.wait(lambda: rig.session._state.step == 1, 'the next state')
    assert len(rig.record.actions) == 1
    assert change(rig, Transition.TRANSITION_ACTIVATE)
    rig.action_for(1)
    assert change(rig, Transition.TRANSITION_DEACTIVATE)
    assert change(rig, Transition.TRANSITION_CLEANUP)
    assert label(rig) == 'unconfigured'
    assert change(rig, Transition.TRANSITION_CONFIGURE)
    assert change(rig, Transition.TRANSITION_CLEANUP)
    assert change(rig, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert label(rig) == 'finalized'


@pytest.mark.parametrize('transition', [99, 255, Transition.TRANSITION_ACTIVATE])
def test_transition_that_there_is_not_changes_nothing(make_rig, transition: int) -> None:
    rig = make_rig(autostart=False)
    assert not change(rig, transition)
    assert label(rig) == 'unconfigured'
    assert change(rig, Transition.TRANSITION_CONFIGURE)


def test_deactivation_in_realtime_sends_a_zero_action(make_rig) -> None:
    rig = make_rig(stepping='realtime', adapt_steps=0, rate_hz=5.0, state_timeout_s=30.0)
    rig.goal()
    rig.state()
    rig.action(lambda action: any(action.values))
    assert change(rig, Transition.TRANSITION_DEACTIVATE)
    rig.graph.wait(lambda: not any(rig.record.actions[-1].values), 'the zero action')


def test_deactivation_cancels_and_activation_adapts_again(make_rig, slow_adaptation) -> None:
    rig = make_rig(adaptation='hold')
    rig.state()
    rig.goal()
    rig.wait_until_adapting()
    assert change(rig, Transition.TRANSITION_DEACTIVATE)
    assert rig.record.actions == []
    slow_adaptation.set()
    rig.graph.wait(lambda: not rig.session._pursuit.adapting, 'the end of the adaptation')
    assert change(rig, Transition.TRANSITION_ACTIVATE)
    assert rig.action().adapted


def mismatched_checkpoint(tmp_path: Path, dataset: Path) -> dict:
    save_checkpoint(make_agent('gcbc', obs_dim=29, act_dim=8, hidden=(8,)), tmp_path / 'ant')
    return {'checkpoint': str(tmp_path / 'ant')}


def missing_checkpoint(tmp_path: Path, dataset: Path) -> dict:
    return {'checkpoint': str(tmp_path / 'nowhere')}


def checkpoint_without_optimizer_state(tmp_path: Path, dataset: Path) -> dict:
    return {'optimizer_state': 'pretrained'}


def broken_dataset(tmp_path: Path, dataset: Path) -> dict:
    path = tmp_path / 'broken.npz'
    path.write_bytes(dataset.read_bytes()[:1000])
    return {'dataset': str(path)}


@pytest.mark.parametrize(
    ('make_wrong', 'message'),
    [
        (checkpoint_without_optimizer_state, 'has no optimiser state of pre-training; '),
        (missing_checkpoint, 'nowhere: no checkpoint there'),
        (broken_dataset, 'broken.npz'),
        (
            mismatched_checkpoint,
            'is for observations of 29 and actions of 8 values, the dataset',
        ),
    ],
)
def test_failed_configuration_says_why_and_can_be_repeated(
    make_rig, make_wrong, message, tmp_path: Path, dataset_file: Path, capfd
) -> None:
    wrong = make_wrong(tmp_path, dataset_file)
    rig = make_rig()
    right = {name: rig.node.get_parameter(name).value for name in wrong}
    assert change(rig, Transition.TRANSITION_DEACTIVATE)
    assert change(rig, Transition.TRANSITION_CLEANUP)
    assert rig.set(**wrong) == ''
    capfd.readouterr()
    assert not change(rig, Transition.TRANSITION_CONFIGURE)
    logged = capfd.readouterr().err
    assert 'cannot configure: ' in logged
    assert message in logged
    assert label(rig) == 'unconfigured'
    assert rig.set(**right) == ''
    assert change(rig, Transition.TRANSITION_CONFIGURE)


@pytest.mark.parametrize('fails', ['deployment_of', 'warm_up', 'PolicySession'])
def test_unforeseen_failure_of_configure_is_named_and_not_final(
    make_rig, monkeypatch, fails, capfd
) -> None:
    rig = make_rig()
    assert change(rig, Transition.TRANSITION_DEACTIVATE)
    assert change(rig, Transition.TRANSITION_CLEANUP)

    def broken(*_args, **_named):
        raise RuntimeError('a cosmic ray')

    with monkeypatch.context() as patch:
        patch.setattr(policy_node, fails, broken)
        assert not change(rig, Transition.TRANSITION_CONFIGURE)
    assert 'configuring failed: RuntimeError: a cosmic ray' in capfd.readouterr().err
    assert rig.node._examine().message == 'configuring failed: RuntimeError: a cosmic ray'
    assert label(rig) == 'unconfigured'
    assert change(rig, Transition.TRANSITION_CONFIGURE)


def test_failed_autostart_leaves_the_node_unconfigured(make_rig, tmp_path: Path) -> None:
    rig = make_rig(dataset=str(tmp_path / 'nowhere.npz'))
    assert label(rig) == 'unconfigured'


# --- parameters -------------------------------------------------------------------------------


def test_adaptation_parameters_apply_to_the_next_query(make_rig) -> None:
    rig = make_rig()
    rig.state()
    rig.goal(1)
    assert rig.report(1).steps == 3
    assert rig.set(adapt_steps=5, adapt_lr=0.01, adapt_batch_size=16, early_stopping=True) == ''
    rig.goal(2)
    report = rig.report(2)
    assert (report.steps, len(report.test_losses)) == (5, 6)
    config = rig.session._pursuit.config
    assert (config.lr, config.batch_size) == (0.01, 16)


def test_rate_applies_at_once(make_rig) -> None:
    rig = make_rig(stepping='realtime', rate_hz=0.1, state_timeout_s=30.0)
    rig.state()
    assert rig.set(rate_hz=100.0) == ''
    rig.graph.wait(lambda: len(rig.record.actions) > 3, 'actions at the new rate', timeout_s=20)


@pytest.mark.parametrize(
    ('values', 'reason'),
    [
        ({'adaptation': 'later'}, "adaptation must be one of async, hold, got 'later'"),
        ({'checkpoint': 'x'}, 'checkpoint is read at configuration: clean the node up first'),
        ({'adapt_steps': -1}, 'adapt_steps'),
        ({'adapt_lr': 2.0}, 'adapt_lr'),
        ({'autostart': False}, 'autostart'),
    ],
)
def test_invalid_value_is_refused_with_a_reason(make_rig, values: dict, reason: str) -> None:
    rig = make_rig()
    [(name, _)] = values.items()
    before = rig.node.get_parameter(name).value
    assert reason in rig.set(**values)
    assert rig.node.get_parameter(name).value == before


def test_dataset_is_untouched_by_the_policy(make_rig, dataset_file: Path) -> None:
    rig = make_rig()
    rig.state()
    rig.goal()
    rig.report()
    stored = TrajectoryDataset.load(dataset_file).observations
    np.testing.assert_array_equal(rig.session.deployment.dataset.observations, stored)
