from pathlib import Path
import threading

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from metagcttt import deployment
from metagcttt.policy_node import PolicyNode
from metagcttt_core import load_checkpoint, make_agent, save_checkpoint, TrajectoryDataset
from metagcttt_interfaces.msg import GoalQuery, MazeState
import numpy as np
import pytest
from rclpy.parameter import Parameter

from tests.ros.graph import EVERY, Graph, Record

ON_THE_WAY = (0.0, 0.0)  # start of task 1, where the dataset's walks begin
TASK_1_GOAL = (20.0, 20.0)


class Rig:
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
            lambda: self.session._query and self.session._query.adapting, 'an adaptation'
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


@pytest.fixture
def make_rig(graph: Graph, checkpoint_folder: Path, dataset_file: Path):
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    return lambda **parameters: Rig(graph, files, **parameters)


@pytest.fixture
def slow_adaptation(monkeypatch: pytest.MonkeyPatch):
    """Adaptations wait until the test lets them go on, or until they are cancelled."""
    go_on = threading.Event()

    def slow_adapt(*args, should_stop, **kwargs):
        while not (go_on.wait(0.001) or should_stop()):
            pass
        return adapt(*args, should_stop=should_stop, **kwargs)

    adapt = deployment.adapt
    monkeypatch.setattr(deployment, 'adapt', slow_adapt)
    return go_on


# --- adapting ---------------------------------------------------------------------------------


def test_query_is_adapted_to_and_reported(make_rig) -> None:
    rig = make_rig()
    rig.state()
    rig.goal()
    report = rig.report()
    assert (report.query_id, report.episode_id) == (1, 1)
    assert (report.accepted, report.reason, report.steps, report.best_step) == (True, '', 3, 3)
    assert 0 < report.kept_trajectories <= report.relevant_trajectories
    lengths = np.subtract(report.segment_stops, report.segment_starts)
    assert len(lengths) == report.kept_trajectories
    assert lengths.sum() == report.transitions > 0
    assert len(report.train_losses) == 3
    assert report.adapt_ms > 0


def test_holding_policy_answers_with_the_expert_only(make_rig, slow_adaptation) -> None:
    rig = make_rig(adaptation='hold')
    rig.state()
    rig.goal()
    rig.graph.wait(lambda: rig.session._query, 'the goal')
    slow_adaptation.set()
    action = rig.action()
    assert (action.query_id, action.adapted, len(rig.record.actions)) == (1, True, 1)


def test_async_policy_answers_with_the_base_policy_meanwhile(make_rig, slow_adaptation) -> None:
    rig = make_rig(adaptation='async')
    rig.state()
    rig.goal()
    action = rig.action_for(0)
    assert not action.adapted
    np.testing.assert_array_equal(action.values, rig.base.act(ON_THE_WAY, TASK_1_GOAL))
    slow_adaptation.set()
    rig.report()
    rig.state(step=1)
    assert rig.action_for(1).adapted


def test_state_far_from_the_data_is_acted_on_with_the_base_policy(make_rig) -> None:
    rig = make_rig(adaptation='hold')
    rig.state(xy=(500.0, 500.0))
    rig.goal()
    report = rig.report()
    assert (report.accepted, report.transitions) == (False, 0)
    assert report.reason == 'the filtered dataset is empty'
    assert not rig.action().adapted


def test_no_steps_mean_the_base_policy(make_rig) -> None:
    rig = make_rig(adapt_steps=0, adaptation='hold')
    rig.state()
    rig.goal()
    assert rig.report().reason == 'adaptation is switched off (0 steps)'
    np.testing.assert_array_equal(rig.action().values, rig.base.act(ON_THE_WAY, TASK_1_GOAL))


def test_newer_goal_cancels_the_adaptation_under_way(make_rig, slow_adaptation) -> None:
    rig = make_rig(adaptation='hold')
    rig.state()
    rig.goal(1)
    rig.graph.wait(
        lambda: rig.session._query and rig.session._query.adapting, 'the first adaptation'
    )
    rig.goal(2)
    report = rig.report(1)
    assert (report.accepted, report.reason) == (
        False,
        'cancelled by a newer goal, a newer episode or a stop',
    )
    slow_adaptation.set()
    assert rig.report(2).accepted
    assert rig.action().query_id == 2


def test_new_episode_cancels_the_adaptation_and_voids_the_goal(make_rig, slow_adaptation) -> None:
    rig = make_rig()
    rig.state()
    rig.goal()
    rig.action_for(0)
    rig.state(episode_id=2, step=7)
    assert 'cancelled' in rig.report().reason
    rig.goal(2, episode_id=2)
    slow_adaptation.set()
    assert rig.report(2).episode_id == 2
    assert [a.query_id for a in rig.record.actions if a.episode_id == 2] == [2]


def test_goal_that_comes_before_its_episode_waits_for_it(make_rig) -> None:
    rig = make_rig(adaptation='hold')
    rig.state()
    rig.goal(episode_id=2)
    rig.graph.wait(lambda: rig.session._query and rig.session._state, 'both')
    rig.state(episode_id=2)
    action = rig.action()
    assert (action.episode_id, action.adapted) == (2, True)


def test_adapts_anew_after_every_horizon(make_rig) -> None:
    rig = make_rig(adaptation='hold', horizon=2)
    rig.goal()
    for step in range(5):
        rig.state(step=step)
        rig.action_for(step)
    rig.graph.wait(lambda: len(rig.record.reports) == 3, 'three reports')


def test_failing_adaptation_is_reported_and_the_base_policy_acts(
    make_rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args, **kwargs):
        raise RuntimeError('out of memory')

    monkeypatch.setattr(deployment, 'adapt', fail)
    rig = make_rig(adaptation='hold')
    rig.state()
    rig.goal()
    assert rig.report().reason == 'failed: out of memory'
    assert not rig.action().adapted


def test_expert_comes_from_the_cache_for_the_same_cells(make_rig) -> None:
    rig = make_rig(cache_size=5, cache_cell_m=2.0, adaptation='hold')
    for query_id, xy in ((1, (0.5, 0.5)), (2, (0.7, 0.3)), (3, (-0.5, 0.5))):
        step = 2 * query_id
        rig.state(xy=xy, step=step)
        rig.graph.wait(
            lambda step=step: rig.session._state and rig.session._state.step == step, 'the state'
        )
        rig.goal(query_id)
        rig.report(query_id)
        rig.state(xy=xy, step=step + 1)
        rig.action(lambda action, query_id=query_id: action.query_id == query_id)
    assert [rig.report(n).cached for n in (1, 2, 3)] == [False, True, False]
    made, found = rig.report(1), rig.report(2)
    assert found.accepted
    assert (found.adapt_ms, list(found.train_losses)) == (0.0, list(made.train_losses))
    second = rig.action(lambda action: action.query_id == 2)
    assert second.adapted
    assert rig.set(cache_size=1).startswith('cache_size is read at configuration')


def test_without_a_cache_every_query_is_adapted_to(make_rig) -> None:
    rig = make_rig()
    rig.state()
    for query_id in (1, 2):
        rig.goal(query_id)
        assert not rig.report(query_id).cached
        assert rig.report(query_id).adapt_ms > 0


@pytest.mark.parametrize(('early_stopping', 'adapted'), [(True, False), (False, True)])
def test_early_stopping_keeps_the_base_policy_when_the_held_out_loss_only_gets_worse(
    make_rig, early_stopping: bool, adapted: bool
) -> None:
    # At this rate one step throws the weights far off.
    rig = make_rig(early_stopping=early_stopping, test_fraction=0.5, adapt_lr=1.0, adapt_steps=2)
    rig.set(adaptation='hold')
    rig.state()
    rig.goal()
    report = rig.report()
    assert report.accepted == adapted
    action = rig.action()
    base = rig.base.act(ON_THE_WAY, TASK_1_GOAL)
    assert np.array_equal(action.values, base) != adapted
    if early_stopping:
        losses = list(report.test_losses)
        assert (report.best_step, len(losses), min(losses)) == (0, 3, losses[0])
        assert report.reason == 'the held-out loss never fell below its start'


def test_early_stopping_takes_the_step_that_does_best_on_the_held_out_part(make_rig) -> None:
    rig = make_rig(early_stopping=True, adapt_steps=8, adapt_lr=0.003, adaptation='hold')
    rig.state()
    rig.goal()
    report = rig.report()
    assert report.accepted
    assert report.best_step == int(np.argmin(report.test_losses)) > 0


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
    known = len(rig.record.actions)
    rig.graph.wait(lambda: len(rig.record.actions) > known + 3, 'actions after the stop')
    assert not any(rig.record.actions[-1].values)


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


def change(rig: Rig, transition: int) -> bool:
    request = ChangeState.Request()
    request.transition.id = transition
    return rig.graph.call(ChangeState, 'policy_node/change_state', request).success


def label(rig: Rig) -> str:
    response = rig.graph.call(GetState, 'policy_node/get_state', GetState.Request())
    return response.current_state.label


def test_lifecycle_through_its_services(make_rig) -> None:
    rig = make_rig(autostart=False, adapt_steps=0)
    assert label(rig) == 'unconfigured'
    rig.state()
    rig.goal()
    assert change(rig, Transition.TRANSITION_CONFIGURE)
    rig.graph.wait(lambda: rig.session._state and rig.session._query, 'state and goal')
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
    rig.graph.wait(lambda: not rig.session._query.adapting, 'the end of the adaptation')
    assert change(rig, Transition.TRANSITION_ACTIVATE)
    assert rig.action().adapted


def mismatched_checkpoint(tmp_path: Path, dataset: Path) -> dict:
    save_checkpoint(make_agent('gcbc', obs_dim=29, act_dim=8, hidden=(8,)), tmp_path / 'ant')
    return {'checkpoint': str(tmp_path / 'ant')}


def missing_checkpoint(tmp_path: Path, dataset: Path) -> dict:
    return {'checkpoint': str(tmp_path / 'nowhere')}


def broken_dataset(tmp_path: Path, dataset: Path) -> dict:
    path = tmp_path / 'broken.npz'
    path.write_bytes(dataset.read_bytes()[:1000])
    return {'dataset': str(path)}


@pytest.mark.parametrize(
    ('make_wrong', 'message'),
    [
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
    config = rig.session._query.config
    assert (config.lr, config.batch_size) == (0.01, 16)


def test_rate_applies_at_once(make_rig) -> None:
    rig = make_rig(stepping='realtime', rate_hz=0.1, state_timeout_s=30.0)
    rig.state()
    assert rig.set(rate_hz=100.0) == ''
    rig.graph.wait(lambda: len(rig.record.actions) > 3, 'actions at the new rate', timeout_s=5)


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
    np.testing.assert_array_equal(rig.session._deployment.dataset.observations, stored)
