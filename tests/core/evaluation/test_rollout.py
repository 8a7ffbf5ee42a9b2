"""Episodes in a small fake simulator: filter, adapt, act, adapt again, count successes."""

from dataclasses import dataclass

from metagcttt_core import adapt, evaluate_success, FilterConfig, TrajectoryFilter, TTTConfig
from metagcttt_core.evaluation import rollout, run_episode
from metagcttt_core.evaluation.rollout import episode_seed
import numpy as np
import pytest
from tests.core.builders import (
    assert_bit_equal,
    dataset_at,
    random_dataset,
    tiny_agent,
    weights_of,
)

TTT = TTTConfig(steps=2, lr=0.1, batch_size=8)


@dataclass
class FakeTask:
    task_id: int


@dataclass
class FakeResult:
    observation: np.ndarray
    terminated: bool
    truncated: bool
    success: bool


class FakeSimulator:
    """The state moves by the action; some tasks are reached after a number of steps."""

    def __init__(self, reached_after: dict[int, int], limit: int = 6) -> None:
        self.reached_after = reached_after
        self.limit = limit
        self.resets: list[tuple[int, int]] = []
        self.actions: list[np.ndarray] = []

    @property
    def tasks(self):
        return tuple(FakeTask(number) for number in self.reached_after)

    def reset(self, task_id=None, seed=None):
        self.resets.append((task_id, seed))
        self.steps = 0
        self.task_id = task_id
        self.state = np.random.default_rng(seed).normal(size=2)
        return self.state, np.array([float(task_id), -1.0])

    def step(self, action):
        self.actions.append(action)
        self.steps += 1
        self.state = self.state + action
        success = self.steps == self.reached_after[self.task_id]
        return FakeResult(self.state, success, self.steps == self.limit, success)


@pytest.fixture
def finder() -> TrajectoryFilter:
    return TrajectoryFilter(random_dataset([30, 30]), FilterConfig(epsilon=6.0, top_percent=100))


def test_base_policy_acts_until_the_goal():
    agent, simulator = tiny_agent(), FakeSimulator({3: 4})
    episode = run_episode(agent, simulator, 3, seed=11)
    assert simulator.resets == [(3, 11)]
    assert (episode.task_id, episode.success, episode.steps) == (3, True, 4)
    assert (episode.observations.shape, episode.actions.shape) == ((5, 2), (4, 2))
    assert (episode.supports, episode.adaptations) == ([], [])
    state = np.random.default_rng(11).normal(size=2)
    for number, action in enumerate(episode.actions):
        assert np.array_equal(episode.observations[number], state)
        assert np.array_equal(action, agent.act(state, np.array([3.0, -1.0])))
        state = state + action
    assert np.array_equal(episode.observations[-1], state)


def test_episode_ends_at_the_limit_without_success():
    episode = run_episode(tiny_agent(), FakeSimulator({1: 99}, limit=6), 1, seed=0)
    assert (episode.success, episode.steps) == (False, 6)


def test_goal_reached_at_the_limit_counts():
    episode = run_episode(tiny_agent(), FakeSimulator({1: 6}, limit=6), 1, seed=0)
    assert (episode.success, episode.steps) == (True, 6)


def test_adapted_policy_acts_and_the_base_stays(finder):
    agent, simulator = tiny_agent(), FakeSimulator({1: 5})
    weights = weights_of(agent)
    episode = run_episode(agent, simulator, 1, seed=4, trajectory_filter=finder, ttt=TTT)
    state, goal = np.random.default_rng(4).normal(size=2), np.array([1.0, -1.0])
    support = finder.query(state, goal)
    assert support
    expected = adapt(agent, finder.dataset, support, goal, TTT, seed=4)
    assert len(episode.supports) == len(episode.adaptations) == 1
    assert episode.supports[0] == support
    assert_bit_equal(episode.adaptations[0].agent, weights_of(expected.agent))
    assert_bit_equal(agent, weights)
    for number, action in enumerate(episode.actions):
        assert np.array_equal(action, expected.agent.act(episode.observations[number], goal))
    assert not np.array_equal(episode.actions[0], agent.act(state, goal))


@pytest.mark.parametrize('horizon', [1, 2, 4])
def test_every_horizon_adapts_again_from_the_base_weights(horizon, finder):
    agent, simulator = tiny_agent(), FakeSimulator({1: 7}, limit=9)
    config = TTT.model_copy(update={'horizon': horizon})
    episode = run_episode(agent, simulator, 1, seed=2, trajectory_filter=finder, ttt=config)
    starts = list(range(0, 7, horizon))
    assert len(episode.adaptations) == len(episode.supports) == len(starts)
    goal = np.array([1.0, -1.0])
    for start, support, adaptation in zip(
        starts, episode.supports, episode.adaptations, strict=True
    ):
        state = episode.observations[start]
        assert support == finder.query(state, goal)
        expected = adapt(agent, finder.dataset, support, goal, config, seed=2)
        assert_bit_equal(adaptation.agent, weights_of(expected.agent))
        for step in range(start, min(start + horizon, 7)):
            action = adaptation.agent.act(episode.observations[step], goal)
            assert np.array_equal(episode.actions[step], action)


def test_empty_support_acts_with_the_base_policy():
    finder = TrajectoryFilter(dataset_at([[(1e3, 1e3), (1e3, 1e3)]]))
    agent = tiny_agent()
    episode = run_episode(
        agent, FakeSimulator({1: 3}), 1, seed=0, trajectory_filter=finder, ttt=TTT
    )
    (adaptation,) = episode.adaptations
    assert (adaptation.accepted, adaptation.agent is agent) == (False, True)
    assert adaptation.reason == 'the filtered dataset is empty'
    goal = np.array([1.0, -1.0])
    assert np.array_equal(episode.actions[0], agent.act(episode.observations[0], goal))


def test_agent_with_a_critic_filters_by_its_value(finder, monkeypatch):
    critics, query = [], TrajectoryFilter.query

    def spy(self, state, goal, value_fn=None):
        critics.append(value_fn)
        return query(self, state, goal, value_fn)

    monkeypatch.setattr(TrajectoryFilter, 'query', spy)
    for name in ('gciql', 'gcbc'):
        agent = tiny_agent(name)
        run_episode(agent, FakeSimulator({1: 3}), 1, 0, trajectory_filter=finder, ttt=TTT)
        assert critics == [agent.value_fn]
        critics.clear()


def test_same_seed_gives_the_same_episode(finder):
    first, again, other = (
        run_episode(
            tiny_agent(), FakeSimulator({1: 5}), 1, seed, trajectory_filter=finder, ttt=TTT
        )
        for seed in (3, 3, 4)
    )
    assert np.array_equal(first.actions, again.actions)
    assert np.array_equal(first.observations, again.observations)
    assert not np.array_equal(first.observations, other.observations)


@pytest.mark.parametrize('ttt', [None, TTTConfig(steps=0)])
def test_without_steps_no_dataset_is_needed(ttt):
    episode = run_episode(tiny_agent(), FakeSimulator({1: 3}), 1, seed=0, ttt=ttt)
    assert (episode.success, episode.adaptations) == (True, [])


def test_adapting_without_a_dataset_is_refused():
    message = 'test-time training needs a dataset or a trajectory filter'
    with pytest.raises(ValueError, match=message):
        run_episode(tiny_agent(), FakeSimulator({1: 3}), 1, seed=0, ttt=TTT)
    with pytest.raises(ValueError, match=message):
        evaluate_success(tiny_agent(), FakeSimulator({1: 3}), ttt=TTT, episodes=1)


def test_success_rates_of_every_task():
    simulator = FakeSimulator({1: 2, 2: 99, 5: 6})
    result = evaluate_success(tiny_agent(), simulator, episodes=3)
    assert result['tasks'] == {1: 1.0, 2: 0.0, 5: 1.0}
    assert result['mean'] == pytest.approx(2 / 3)
    assert result['steps'] == {1: 2.0, 2: None, 5: 6.0}
    assert [task for task, _ in simulator.resets] == [1] * 3 + [2] * 3 + [5] * 3


def test_rate_and_steps_count_the_successful_episodes_only():
    simulator = FakeSimulator({1: 99})
    outcomes = iter([2, 99, 4, 99])
    reset = simulator.reset

    def changing_reset(task_id, seed):
        simulator.reached_after[1] = next(outcomes)
        return reset(task_id, seed)

    simulator.reset = changing_reset
    result = evaluate_success(tiny_agent(), simulator, episodes=4)
    assert (result['tasks'], result['mean'], result['steps']) == ({1: 0.5}, 0.5, {1: 3.0})


def test_chosen_tasks_only():
    simulator = FakeSimulator({1: 2, 2: 99, 5: 6})
    result = evaluate_success(tiny_agent(), simulator, episodes=2, tasks=(5, 2))
    assert result['tasks'] == {5: 1.0, 2: 0.0}
    assert {task for task, _ in simulator.resets} == {2, 5}


def test_every_episode_has_a_seed_of_its_own_that_repeats():
    runs = []
    for seed in (0, 0, 1):
        simulator = FakeSimulator({1: 2, 2: 3})
        evaluate_success(tiny_agent(), simulator, episodes=4, seed=seed)
        runs.append(simulator.resets)
    assert runs[0] == runs[1]
    seeds = [{seed for _, seed in run} for run in runs]
    assert len(seeds[0]) == 8
    assert not seeds[0] & seeds[2]
    # One task alone sees the same episodes.
    alone = FakeSimulator({1: 2, 2: 3})
    evaluate_success(tiny_agent(), alone, episodes=4, tasks=[2])
    assert alone.resets == runs[0][4:]


def test_episode_seeds_fit_every_simulator():
    seeds = {
        episode_seed(seed, task, number)
        for seed in range(5)
        for task in range(1, 6)
        for number in range(50)
    }
    assert len(seeds) == 5 * 5 * 50
    assert min(seeds) >= 0
    assert max(seeds) < 2**31


def test_dataset_is_filtered_with_the_default_settings_once(monkeypatch):
    built = []

    class Spy(TrajectoryFilter):
        def __init__(self, dataset, config=None):
            built.append((dataset, config))
            super().__init__(dataset, config)

    monkeypatch.setattr(rollout, 'TrajectoryFilter', Spy)
    dataset = random_dataset()
    evaluate_success(tiny_agent(), FakeSimulator({1: 2, 2: 2}), dataset, TTT, episodes=2)
    assert built == [(dataset, None)]
    evaluate_success(tiny_agent(), FakeSimulator({1: 2}), dataset, episodes=1)
    assert len(built) == 1


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ({'episodes': 0}, 'episodes must be at least 1, got 0'),
        ({'tasks': []}, 'tasks must hold at least one task number, got none'),
    ],
)
def test_empty_evaluation_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        evaluate_success(tiny_agent(), FakeSimulator({1: 2}), **arguments)
