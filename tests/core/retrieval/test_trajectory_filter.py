"""TrajectoryFilter: what a query costs, what it refuses, and the nearest row."""

import tracemalloc

from hypothesis import given
from hypothesis import strategies as st
from metagcttt_core import FilterConfig, TrajectoryDataset, TrajectoryFilter
from metagcttt_core.data import GoalRelabeller
from metagcttt_core.retrieval import FilterSettings
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.step import gradient_step
import numpy as np
import pytest

from tests.core.builders import dataset_at, random_dataset, terminals_of, tiny_agent

ORIGIN = np.zeros(2)


class CountingCritic:
    """V = minus the distance to (9, 0); remembers every state it is asked about."""

    def __init__(self) -> None:
        self.calls: list[np.ndarray] = []
        self.goals: list[np.ndarray] = []

    def __call__(self, observations, goal):
        self.calls.append(observations)
        self.goals.append(goal)
        return -np.abs(observations[:, 0] - 9)

    @property
    def rows(self) -> list[int]:
        """Number (third coordinate) of every evaluated state, in order."""
        return [int(number) for call in self.calls for number in call[:, 2]]


def numbered(trajectories) -> TrajectoryDataset:
    """A dataset whose states carry the number of their row as a third coordinate."""
    dataset = dataset_at(trajectories)
    numbers = np.arange(dataset.num_rows, dtype=np.float32)[:, None]
    return TrajectoryDataset.from_arrays(
        np.hstack([dataset.observations, numbers]), dataset.actions, dataset.terminals
    )


@pytest.fixture
def corridor() -> TrajectoryDataset:
    """Two trajectories through the origin (in row 2 and row 6), one far away."""
    return numbered(
        [
            [(-4, 0), (-2, 0), (0, 0), (2, 0), (4, 0)],
            [(0.5, 0), (0, 0), (3, 0)],
            [(50, 0), (51, 0), (52, 0)],
        ]
    )


@pytest.mark.parametrize(
    ('variant', 'expected'),
    [
        ('paper', [2, 3, 4, 6, 7]),  # relevant trajectories, from the closest state on
        ('gcttt', [4, 7]),  # at least min_steps after the first match
        ('score_only', list(range(11))),
        ('relevance_only', []),
        ('random', []),
    ],
)
def test_critic_is_asked_once_about_rows_that_can_matter(corridor, variant, expected):
    critic = CountingCritic()
    finder = TrajectoryFilter(corridor, FilterConfig(variant=variant, min_steps=2))
    finder.query(np.array([0.0, 0.0, 0.0]), np.array([9.0, 0.0, 0.0]), critic)
    assert critic.rows == expected


def test_critic_is_not_asked_again_for_the_same_goal(corridor):
    critic = CountingCritic()
    finder = TrajectoryFilter(corridor, FilterConfig(top_percent=100))
    goal = np.array([9.0, 0.0, 0.0])
    first = finder.query(np.zeros(3), goal, critic)
    again = finder.query(np.zeros(3), goal, critic)
    assert critic.rows == [2, 3, 4, 6, 7]
    assert again == first
    finder.query(np.array([-4.0, 0, 0]), goal, critic)  # from farther back: two more rows
    assert critic.rows[5:] == [0, 1]
    finder.query(np.zeros(3), goal + 1, critic)
    assert critic.rows[7:] == [2, 3, 4, 6, 7]


def test_critic_gets_float32_rows_and_the_goal(corridor):
    critic = CountingCritic()
    TrajectoryFilter(corridor).query(np.zeros(3), np.array([9.0, 0.25, 1.0]), critic)
    assert critic.calls[0].dtype == critic.goals[0].dtype == np.float32
    assert critic.goals[0].tolist() == [9.0, 0.25, 1.0]


def test_critic_is_asked_in_batches(corridor, monkeypatch):
    monkeypatch.setattr('metagcttt_core.retrieval.value_cache._BATCH_ROWS', 2)
    critic = CountingCritic()
    found = TrajectoryFilter(corridor, FilterConfig(top_percent=100)).query(
        np.zeros(3), np.array([9.0, 0.0, 0.0]), critic
    )
    assert [len(call) for call in critic.calls] == [2, 2, 1]
    assert found.segments == [(2, 4), (6, 7)]
    assert found.scores.tolist() == [-5, -6]


def test_prefetched_values_answer_every_query_of_that_goal(corridor):
    critic, goal = CountingCritic(), np.array([9.0, 0.0, 0.0])
    finder = TrajectoryFilter(corridor)
    assert finder.prefetch_values(critic, goal)
    assert critic.rows == list(range(11))
    finder.query(np.zeros(3), goal, critic)
    finder.query(np.array([51.0, 0, 0]), goal, critic)
    assert len(critic.rows) == 11


def test_prefetch_stops_when_asked_and_keeps_what_it_has(corridor, monkeypatch):
    monkeypatch.setattr('metagcttt_core.retrieval.value_cache._BATCH_ROWS', 4)
    critic, goal = CountingCritic(), np.array([9.0, 0.0, 0.0])
    finder = TrajectoryFilter(corridor)
    assert not finder.prefetch_values(critic, goal, lambda: len(critic.calls) == 2)
    assert critic.rows == list(range(8))
    assert finder.prefetch_values(critic, goal)
    assert critic.rows == list(range(11))


@pytest.mark.parametrize('optimizer', ['adam', 'sgd'])
def test_values_follow_the_weights_of_an_agent_that_is_trained(optimizer):
    """A remembered V must not outlive the weights that gave it."""
    dataset = random_dataset([20, 20])
    config = FilterConfig(epsilon=100, top_percent=100)
    finder = TrajectoryFilter(dataset, config)
    agent = tiny_agent('gciql')
    goal = np.ones(2)
    untrained = agent.clone()
    before = finder.query(ORIGIN, goal, agent.value_fn)
    parameters = list(agent.trained_parameters())
    batch = GoalRelabeller(dataset, agent.settings.goals).sample(8, np.random.default_rng(0))
    gradient_step(
        agent, make_optimizer(optimizer, parameters, 0.1), parameters, agent.tensors(batch)
    )
    after = finder.query(ORIGIN, goal, agent.value_fn)
    assert after != before
    assert after == TrajectoryFilter(dataset, config).query(ORIGIN, goal, agent.value_fn)
    assert finder.query(ORIGIN, goal, untrained.value_fn) == before


def test_batched_query_equals_single_queries():
    dataset = random_dataset([30, 30, 30], seed=4)
    finder = TrajectoryFilter(dataset, FilterConfig(epsilon=2.0))
    states, goals = dataset.observations[[0, 10, 40]], dataset.observations[[20, 29, 80]]
    batched = finder.query_batch(states, goals)
    assert len(batched) == 3
    for support, state, goal in zip(batched, states, goals, strict=True):
        assert support == finder.query(state, goal)
    assert any(batched)


def test_batched_query_of_different_lengths_is_refused():
    finder = TrajectoryFilter(random_dataset())
    with pytest.raises(ValueError, match=r'states and goals must both have shape \(n, 2\), got'):
        finder.query_batch(np.zeros((3, 2)), np.zeros((2, 2)))


def test_memory_mapped_dataset_gives_the_same_supports(tmp_path):
    dataset = random_dataset([40, 40], obs_dim=4, seed=2)
    dataset.save(tmp_path / 'data.npz')
    mapped = TrajectoryDataset.load(tmp_path / 'data.npz', memory_map=True)
    config = FilterConfig(epsilon=3.0, position_dims=(3, 0, 1), top_percent=100)
    state, goal = dataset.observations[5], dataset.observations[30]
    expected = TrajectoryFilter(dataset, config).query(state, goal)
    found = TrajectoryFilter(mapped, config).query(state, goal)
    assert expected
    assert found == expected


def test_contract_of_the_data_decides_about_distances_that_are_left_out():
    dataset = random_dataset([40, 40], obs_dim=4, seed=2)
    dataset.contract = {'epsilon': 3.0, 'position_dims': [3, 0, 1]}
    state, goal = dataset.observations[5], dataset.observations[30]
    same = FilterConfig(epsilon=3.0, position_dims=(3, 0, 1))
    other = FilterConfig(epsilon=3.0)
    expected, different = (TrajectoryFilter(dataset, c).query(state, goal) for c in (same, other))
    for settings in (None, FilterSettings(), FilterSettings(epsilon=3.0)):
        finder = TrajectoryFilter(dataset, settings)
        assert finder.config == same
        found = finder.query(state, goal)
        assert found == expected != different


@pytest.mark.parametrize('epsilon', [1e-3, 1.0])
def test_index_takes_at_most_64_bytes_a_row(epsilon):
    """At the small radius nearly every row has a cell of its own."""
    rng = np.random.default_rng(0)
    rows = 50_000
    dataset = TrajectoryDataset.from_arrays(
        rng.uniform(0, 30, size=(rows, 2)), np.zeros((rows, 1)), terminals_of([rows])
    )
    tracemalloc.start()
    try:
        finder = TrajectoryFilter(dataset, FilterConfig(epsilon=epsilon))
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert finder.index_bytes <= held <= 64 * rows


@st.composite
def places(draw):
    """Positions on a lattice, coordinates and scale to use, and a point to look from."""
    width = draw(st.integers(1, 4))
    halves = st.integers(-6, 6).map(lambda number: number / 2)
    place = st.lists(halves, min_size=width, max_size=width)
    states = draw(st.lists(place, min_size=1, max_size=20))
    dims = draw(st.permutations(range(width)))[: draw(st.integers(1, width))]
    scale = draw(st.sampled_from([None, 0.5, 2.0]))
    far = draw(st.sampled_from([0, 0, 10, 1000]))
    point = [draw(halves) + far for _ in dims]
    config = FilterConfig(
        position_dims=tuple(dims),
        scale=None if scale is None else tuple(scale * (1 + dim) for dim in range(len(dims))),
        epsilon=draw(st.sampled_from([0.25, 1.0, 4.0])),
    )
    return dataset_at([states]), config, np.array(point)


@given(places())
def test_nearest_row_is_the_first_of_the_closest(case):
    dataset, config, point = case
    offsets = dataset.observations[:, list(config.position_dims)].astype(np.float64) - point
    distances = np.sqrt(((offsets * (config.scale or 1.0)) ** 2).sum(axis=1))
    row = TrajectoryFilter(dataset, config).nearest_row(point)
    assert row == int(np.argmin(distances))
    assert isinstance(row, int)


@pytest.mark.parametrize(
    ('position', 'got'),
    [([0.0], r'\[0.\]'), ([0.0, 0.0, 0.0], ''), ([[0.0, 0.0]], ''), ([0.0, np.nan], 'nan')],
)
def test_wrong_position_is_refused(position, got):
    finder = TrajectoryFilter(random_dataset())
    with pytest.raises(ValueError, match=f'position must be 2 finite numbers, got .*{got}'):
        finder.nearest_row(position)


@pytest.mark.parametrize('name', ['state', 'goal'])
@pytest.mark.parametrize(
    ('value', 'message'),
    [
        (np.zeros(3), r'must have shape \(2,\), got \(3,\)'),
        (np.zeros((1, 2)), r'must have shape \(2,\), got \(1, 2\)'),
        (np.float64(1), r'must have shape \(2,\), got \(\)'),
        (np.array([0, np.nan]), 'holds a non-finite value'),
        (np.array([np.inf, 0]), 'holds a non-finite value'),
    ],
)
def test_wrong_query_is_refused_by_name(name, value, message):
    finder = TrajectoryFilter(random_dataset())
    with pytest.raises(ValueError, match=f'^{name} {message}'):
        finder.query(**{'state': ORIGIN, 'goal': ORIGIN, name: value})


@pytest.mark.parametrize(
    ('answer', 'message'),
    [
        (lambda n: np.zeros((n, 1)), r'value_fn must return shape \(3,\), got \(3, 1\)'),
        (lambda n: np.zeros(n + 1), r'value_fn must return shape \(3,\), got \(4,\)'),
        (lambda n: np.full(n, np.nan), 'value_fn returned a non-finite value'),
        (lambda n: np.full(n, np.inf), 'value_fn returned a non-finite value'),
    ],
)
def test_wrong_critic_is_refused(answer, message):
    finder = TrajectoryFilter(dataset_at([[(0, 0), (1, 0), (2, 0)]]))
    with pytest.raises(ValueError, match=message):
        finder.query(ORIGIN, ORIGIN, lambda observations, goal: answer(len(observations)))


def test_refused_values_are_not_remembered():
    finder = TrajectoryFilter(dataset_at([[(0, 0), (1, 0), (2, 0)]]))
    answers = [np.array([0.0, np.nan, 0.0]), np.array([3.0, 4.0, 5.0])]

    def flaky(observations, goal):
        return answers.pop(0)

    with pytest.raises(ValueError, match='non-finite'):
        finder.query(ORIGIN, ORIGIN, flaky)
    assert finder.query(ORIGIN, ORIGIN, flaky).scores.tolist() == [5]


def test_position_dimension_beyond_the_observation_is_refused():
    message = r'position_dims \(0, 2\) must be below the width of an observation, which is 2'
    with pytest.raises(ValueError, match=message):
        TrajectoryFilter(random_dataset(), FilterConfig(position_dims=(0, 2)))


def test_query_changes_neither_dataset_nor_arguments():
    dataset = random_dataset([20, 20])
    copies = dataset.observations.copy(), dataset.actions.copy()
    state, goal = np.array([1.0, 2.0]), np.array([3.0, 4.0])
    TrajectoryFilter(dataset, FilterConfig(epsilon=5)).query(state, goal)
    assert np.array_equal(dataset.observations, copies[0])
    assert np.array_equal(dataset.actions, copies[1])
    assert (state.tolist(), goal.tolist()) == ([1, 2], [3, 4])
