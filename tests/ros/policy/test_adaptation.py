"""What the policy node makes of goals: experts, in time, and reports on them."""

from functools import partial
from pathlib import Path
import threading

from metagcttt import deployment
from metagcttt.goal_in_force import Goal
from metagcttt_core import adapt, FilterConfig, make_agent, save_checkpoint, TTTConfig
from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_core.agents.gciql import StateValue
from metagcttt_core.training.engine import AnalyticEngine
import numpy as np
import pytest
from tests.ros.graph import Graph
from tests.ros.policy_rig import ON_THE_WAY, PolicyRig, TASK_1_GOAL


@pytest.fixture
def make_rig(graph: Graph, checkpoint_folder: Path, dataset_file: Path):
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    return lambda **parameters: PolicyRig(graph, files, **parameters)


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
    rig.graph.wait(lambda: rig.session._pursuit, 'the goal')
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
        lambda: rig.session._pursuit and rig.session._pursuit.adapting, 'the first adaptation'
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
    rig.graph.wait(lambda: rig.session._pursuit and rig.session._state, 'both')
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

    rig = make_rig(adaptation='hold')
    monkeypatch.setattr(deployment, 'adapt', fail)
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


def test_guard_keeps_the_base_policy_and_says_why(make_rig) -> None:
    rig = make_rig(test_fraction=0.5, adapt_lr=1.0, adapt_steps=2)
    rig.set(guard='imitation', adaptation='hold')
    rig.state()
    rig.goal()
    report = rig.report()
    assert not report.accepted
    assert report.reason.startswith('the held-out imitation went from')
    assert np.array_equal(rig.action().values, rig.base.act(ON_THE_WAY, TASK_1_GOAL))
    rig.set(adapt_lr=0.003)
    rig.goal(2)
    assert rig.report(2).accepted


def test_early_stopping_takes_the_step_that_does_best_on_the_held_out_part(make_rig) -> None:
    rig = make_rig(early_stopping=True, adapt_steps=8, adapt_lr=0.003, adaptation='hold')
    rig.state()
    rig.goal()
    report = rig.report()
    assert report.accepted
    assert report.best_step == int(np.argmin(report.test_losses)) > 0


def test_superseded_adaptation_takes_no_further_gradient_step(
    make_rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_third_step, superseded = threading.Event(), threading.Event()
    steps: list[int] = []  # number of inner steps of each adaptation since the node is ready

    def counted(engine, batch):
        if not hasattr(engine, 'counted'):
            engine.counted = True
            steps.append(0)
        steps[-1] += 1
        if steps == [3]:
            in_third_step.set()
            assert superseded.wait(30)
        return step(engine, batch)

    step = AnalyticEngine.step
    rig = make_rig(adapt_steps=1000, adaptation='hold')
    monkeypatch.setattr(AnalyticEngine, 'step', counted)
    rig.state()
    rig.goal(1)
    rig.graph.wait(in_third_step.is_set, 'the third step')
    rig.set(adapt_steps=4)
    rig.goal(2)
    rig.graph.wait(lambda: rig.session._pursuit.goal.query_id == 2, 'the second goal')
    superseded.set()
    assert 'cancelled' in rig.report(1).reason
    assert rig.report(2).accepted
    assert steps == [3, 4]


# --- with a critic ----------------------------------------------------------------------------


@pytest.fixture
def critic_rig(graph: Graph, dataset_file: Path, tmp_path: Path):
    agent = make_agent('gciql', obs_dim=2, act_dim=2, hidden=(16, 16))
    save_checkpoint(agent, tmp_path / 'gciql')
    files = {'checkpoint': str(tmp_path / 'gciql'), 'dataset': str(dataset_file)}
    return partial(PolicyRig, graph, files, adaptation='hold', horizon=2)


def test_policy_with_a_critic_adapts_anew_as_the_offline_adaptation_does(critic_rig) -> None:
    rig = critic_rig()
    rig.goal()
    deployed = rig.session.deployment
    for step, xy in enumerate([(0.0, 0.0), (0.5, 0.0), (1.0, 0.0)]):
        rig.state(xy, step)
        action = rig.action_for(step)
        assert action.adapted
        if step == 1:
            continue  # acted on with the expert of step 0
        support = deployed.trajectory_filter.query(
            np.array(xy), np.array(TASK_1_GOAL), rig.base.value_fn
        )
        config = rig.session._pursuit.config
        expert = adapt(rig.base, deployed.dataset, support, np.array(TASK_1_GOAL), config).agent
        np.testing.assert_array_equal(action.values, expert.act(np.array(xy), TASK_1_GOAL))
    rig.graph.wait(lambda: len(rig.record.reports) == 2, 'the second report')


def test_critic_is_evaluated_towards_the_goal_before_the_next_adaptation(critic_rig) -> None:
    rig = critic_rig()
    evaluated: list[int] = []
    value_cache = rig.session.deployment.trajectory_filter._value_cache
    evaluate = value_cache._evaluate

    def counted(value_fn, goal, known, rows) -> None:
        evaluated.append(len(rows))
        evaluate(value_fn, goal, known, rows)

    value_cache._evaluate = counted
    rig.goal()
    rig.state()
    rig.action_for(0)
    num_rows = rig.session.deployment.dataset.num_rows
    rig.graph.wait(lambda: sum(evaluated) == num_rows, 'V of every row')
    rig.graph.wait(lambda: not rig.session._adapter.num_pending, 'the end of the evaluation')
    rig.state(step=2)
    rig.action_for(2)
    rig.graph.wait(lambda: len(rig.record.reports) == 2, 'the second adaptation')
    assert sum(evaluated) == num_rows


@pytest.mark.parametrize('horizon', [0, 2])
def test_critic_is_evaluated_ahead_only_for_goals_that_are_adapted_to_again(
    critic_rig, horizon: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = critic_rig(horizon=horizon)
    ahead: list[list[float]] = []
    found = rig.session.deployment.trajectory_filter
    monkeypatch.setattr(found, 'prefetch_values', lambda _, goal, __: ahead.append(list(goal)))
    rig.goal()
    rig.state()
    rig.action_for(0)
    rig.graph.wait(lambda: not rig.session._adapter.num_pending, 'the end of all jobs')
    assert ahead == ([list(TASK_1_GOAL)] if horizon else [])


def test_stop_is_heeded_before_the_critic_is_evaluated_any_further(
    dataset_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = make_agent('gciql', obs_dim=2, act_dim=2, hidden=(16, 16))
    save_checkpoint(agent, tmp_path / 'gciql')
    deployed = deployment.load_deployment(
        str(tmp_path / 'gciql'), str(dataset_file), FilterConfig()
    )
    goal = Goal(1, 1, np.array(TASK_1_GOAL), TASK_1_GOAL, seed=0)
    evaluated: list[int] = []

    def value(self, observations, goal):
        evaluated.append(len(observations))
        return np.zeros(len(observations), np.float32)

    monkeypatch.setattr(StateValue, '__call__', value)
    with pytest.raises(AdaptationCancelled, match='while the critic was evaluated'):
        deployment.adapt_to_goal(
            deployed, np.zeros(2), goal, TTTConfig(steps=1), should_stop=lambda: True
        )
    assert evaluated == []
    deployment.prefetch_values(deployed, goal, should_stop=lambda: False)
    assert sum(evaluated) == deployed.dataset.num_rows
