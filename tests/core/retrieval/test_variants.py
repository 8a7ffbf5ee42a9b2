"""Which rows each variant selects: golden masks, and a slow reference on awkward geometry."""

from collections.abc import Callable
from dataclasses import dataclass
import math

from hypothesis import given, settings
from hypothesis import strategies as st
from metagcttt_core import FilterConfig, SupportSet, TrajectoryDataset, TrajectoryFilter
from metagcttt_core.retrieval.variants import smallest_per_episode
import numpy as np
import pytest

from tests.core.builders import DATA, dataset_at, terminals_of
from tests.core.retrieval import reference
from tests.core.retrieval.reference import Answer

MANY_EXAMPLES = settings(max_examples=2 * settings().max_examples)


@dataclass
class Problem:
    """A dataset on a lattice, settings without a variant, and a query."""

    dataset: TrajectoryDataset
    settings: dict
    state: np.ndarray
    goal: np.ndarray
    value_fn: Callable

    def config(self, variant: str, **changes) -> FilterConfig:
        return FilterConfig(variant=variant, **{**self.settings, **changes})

    def query(self, config: FilterConfig, *, critic: bool) -> SupportSet:
        value_fn = self.value_fn if critic else None
        return TrajectoryFilter(self.dataset, config).query(self.state, self.goal, value_fn)

    def episode_rows(self) -> list[tuple[int, int]]:
        """(start, stop) of the transitions of each trajectory."""
        starts, ends = self.dataset.episode_starts, self.dataset.episode_ends
        return [(int(start), int(end)) for start, end in zip(starts, ends, strict=True)]


@st.composite
def problems(draw) -> Problem:
    """Half-integer coordinates, so that ties, duplicates and exact-epsilon distances abound.

    The last coordinate of a state is its value; positions never use it.
    """
    width = draw(st.integers(1, 4))
    halves = st.integers(-4, 4).map(lambda number: number / 2)
    positions = st.lists(halves, min_size=width, max_size=width)
    states = st.builds(lambda place, value: [*place, value], positions, st.integers(0, 4))
    trajectories = draw(st.lists(st.lists(states, min_size=1, max_size=8), min_size=1, max_size=7))
    dataset = dataset_at(trajectories)
    dims = draw(st.permutations(range(width)))[: draw(st.integers(1, width))]
    scales = st.lists(
        st.sampled_from([0.5, 1.0, 2.0]), min_size=len(dims), max_size=len(dims)
    ).map(tuple)
    choice = {'top_k': draw(st.integers(1, 5))}
    if draw(st.booleans()):
        choice = {'top_percent': draw(st.sampled_from([0.5, 20.0, 25.0, 50.0, 62.5, 100.0]))}
    stored = st.sampled_from(list(dataset.observations)).map(lambda row: row.astype(np.float64))
    far = positions.map(lambda place: np.array([*place, 0.0]) + 100)
    place = positions.map(lambda place: np.array([*place, 0.0]))
    state = draw(st.one_of(stored, place, far))
    goal = draw(st.one_of(stored, place, far, st.just(state)))
    factor, shift = draw(st.sampled_from([(1, 0), (-1, -1), (-40, 10), (0, -3)]))
    return Problem(
        dataset,
        {
            'epsilon': draw(st.sampled_from([0.5, 1.0, 1.5, math.sqrt(2), math.sqrt(0.5), 2.0])),
            'position_dims': tuple(dims),
            'scale': draw(st.none() | scales),
            'slack': draw(st.integers(0, 5)),
            'min_steps': draw(st.integers(0, 4)),
            **choice,
        },
        state,
        goal,
        lambda observations, goal: factor * observations[:, -1] + shift,
    )


def assert_answers(support: SupportSet, answer: Answer, dataset: TrajectoryDataset) -> None:
    """The support set is the reference's answer in every respect."""
    segments = [(part.start, part.last + 1) for part in answer.kept]
    assert support.segments == segments
    rows = [row for start, stop in segments for row in range(start, stop)]
    assert support.indices.tolist() == rows
    assert support.indices.dtype == np.int64
    assert support.episodes.tolist() == [part.episode for part in answer.kept]
    assert support.scores.dtype == np.float64
    np.testing.assert_allclose(support.scores, [part.score for part in answer.kept], rtol=1e-12)
    assert support.num_relevant == answer.relevant
    assert support.num_scored == len(answer.scored)
    assert support.num_dropped == answer.relevant - len(answer.scored)
    assert support.num_kept == len(answer.kept)
    assert support.num_transitions == len(support) == len(rows)
    assert support.milliseconds > 0


@pytest.mark.parametrize('critic', [False, True])
@MANY_EXAMPLES
@given(problem=problems())
def test_paper_equals_the_reference(problem, critic):
    config = problem.config('paper')
    expected = reference.paper(
        problem.dataset, config, problem.state, problem.goal, problem.value_fn if critic else None
    )
    support = problem.query(config, critic=critic)
    assert_answers(support, expected, problem.dataset)
    assert not problem.dataset.terminals[support.indices].any()


@MANY_EXAMPLES
@given(problem=problems())
def test_critic_free_gcttt_equals_the_reference(problem):
    config = problem.config('gcttt')
    expected = reference.gcttt_by_steps(problem.dataset, config, problem.state, problem.goal)
    assert_answers(problem.query(config, critic=False), expected, problem.dataset)


@MANY_EXAMPLES
@given(problem=problems())
def test_critic_based_gcttt_equals_the_reference(problem):
    config = problem.config('gcttt')
    expected = reference.gcttt_by_value(
        problem.dataset, config, problem.state, problem.goal, problem.value_fn
    )
    assert_answers(problem.query(config, critic=True), expected, problem.dataset)


@pytest.mark.parametrize('critic', [False, True])
@given(problem=problems())
def test_score_only_is_the_paper_without_relevance(problem, critic):
    config = problem.config('score_only')
    expected = reference.paper(
        problem.dataset,
        config,
        problem.state,
        problem.goal,
        problem.value_fn if critic else None,
        relevance=False,
    )
    support = problem.query(config, critic=critic)
    assert support.segments == [(part.start, part.last + 1) for part in expected.kept]
    assert support.scores.tolist() == [part.score for part in expected.kept]
    assert support.num_dropped == problem.dataset.num_episodes - len(expected.scored)


@given(problem=problems(), seed=st.integers(0, 1000))
def test_relevance_only_draws_among_the_relevant_trajectories(problem, seed):
    config = problem.config('relevance_only', seed=seed)
    support = problem.query(config, critic=False)
    # With a constant critic, every relevant trajectory is scored, and all ends are starts.
    relevant = reference.paper(
        problem.dataset,
        config,
        problem.state,
        problem.goal,
        lambda observations, goal: np.zeros(len(observations)),
    ).scored
    starts = {part.episode: part.start for part in relevant}
    ends = problem.dataset.episode_ends
    assert support.num_relevant == support.num_scored == len(starts)
    count = config.top_k or max(1, math.ceil(config.top_percent * len(starts) / 100))
    assert support.num_kept == min(count, len(starts))
    assert support.segments == [
        (starts[episode], max(starts[episode], int(ends[episode]))) for episode in support.episodes
    ]
    assert (np.diff(support.episodes) > 0).all()
    assert problem.query(config, critic=True).segments == support.segments


@given(problem=problems(), seed=st.integers(0, 1000))
def test_random_draws_whole_trajectories_blind_to_the_query(problem, seed):
    config = problem.config('random', seed=seed)
    support = problem.query(config, critic=False)
    spans = problem.episode_rows()
    count = config.top_k or max(1, math.ceil(config.top_percent * len(spans) / 100))
    assert support.num_kept == min(count, len(spans))
    assert support.segments == [spans[episode] for episode in support.episodes]
    assert (np.diff(support.episodes) > 0).all()
    assert support.num_dropped == 0
    problem.state, problem.goal = problem.goal + 7, problem.state - 7
    assert problem.query(config, critic=True).segments == support.segments


@pytest.mark.parametrize('variant', ['random', 'relevance_only'])
def test_drawn_trajectories_are_uniform_over_seeds(variant):
    dataset = dataset_at([[(0, 0), (1, 0)]] * 5)
    kept = np.zeros(5)
    for seed in range(500):
        config = FilterConfig(variant=variant, top_k=2, seed=seed)
        kept[TrajectoryFilter(dataset, config).query(np.zeros(2), np.zeros(2)).episodes] += 1
    assert kept.sum() == 1000
    assert abs(kept - 200).max() < 50


@pytest.mark.parametrize('variant', ['paper', 'gcttt', 'relevance_only'])
@pytest.mark.parametrize('critic', [False, True])
def test_state_far_from_all_data_gives_an_empty_support(variant, critic):
    dataset = dataset_at([[(0, 0), (1, 0), (2, 0)]] * 3)
    value_fn = (lambda observations, goal: -np.ones(len(observations))) if critic else None
    found = TrajectoryFilter(dataset, FilterConfig(variant=variant)).query(
        np.array([50.0, 50.0]), np.zeros(2), value_fn
    )
    assert not found
    assert found.indices.shape == (0,)
    assert found.indices.dtype == np.int64
    assert (found.segments, found.scores.tolist(), found.num_relevant) == ([], [], 0)


def test_goal_far_from_all_data_drops_every_trajectory_only_without_a_critic():
    dataset = dataset_at([[(0, 0), (1, 0), (2, 0)]] * 3)
    finder = TrajectoryFilter(dataset, FilterConfig(top_percent=100))
    state, goal = np.zeros(2), np.array([50.0, 50.0])
    found = finder.query(state, goal)
    assert (found.num_relevant, found.num_dropped, found.num_kept) == (3, 3, 0)
    found = finder.query(state, goal, lambda observations, goal: observations[:, 0])
    assert (found.num_relevant, found.num_dropped, found.num_kept) == (3, 0, 3)


def test_paper_by_hand():
    """Two trajectories pass s and reach g, one passes s only, one passes g before s."""
    dataset = dataset_at(
        [
            [(-2, 0), (0.4, 0), (0.1, 0), (3, 0), (5.5, 0), (5.9, 0), (9, 0)],
            [(0, 0), (1, 0), (2, 0)],
            [(6, 0), (3, 0), (0, 0), (0, 0)],
            [(0, 0.9), (3, 0), (6, 0)],
        ]
    )
    config = FilterConfig(top_percent=100)
    found = TrajectoryFilter(dataset, config).query(np.zeros(2), np.array([6.0, 0.0]))
    assert (found.num_relevant, found.num_dropped, found.num_kept) == (4, 2, 2)
    # From row 2, closest to s, to row 5, closest to g; the other ends with its trajectory.
    assert found.segments == [(2, 6), (14, 16)]
    assert found.indices.tolist() == [2, 3, 4, 5, 14, 15]
    assert found.scores == pytest.approx([-0.1, 0.0], abs=1e-6)
    best = TrajectoryFilter(dataset, FilterConfig(top_k=1)).query(
        np.zeros(2), np.array([6.0, 0.0])
    )
    assert best.segments == [(14, 16)]


@pytest.mark.parametrize('name', ['navigate', 'stitch'])
@pytest.mark.parametrize('parameters', ['default', 'alt'])
@pytest.mark.parametrize('critic', [False, True])
def test_gcttt_reproduces_the_masks_of_the_published_code(name, parameters, critic):
    with np.load(DATA / f'filter_{name}.npz') as arrays:
        golden = {
            key: arrays[key]
            for key in arrays.files
            if not key.startswith(('default', 'alt')) or key.startswith(f'{parameters}.')
        }
    rows = len(golden['observations'])
    # A row's number travels along, so that the made-up values can be looked up.
    numbered = np.column_stack([golden['observations'], np.arange(rows, dtype=np.float32)])
    lengths = [int(golden['episode_len'])] * int(golden['n_episodes'])
    dataset = TrajectoryDataset.from_arrays(numbered, golden['actions'], terminals_of(lengths))
    config = FilterConfig(
        variant='gcttt',
        epsilon=float(golden[f'{parameters}.sim_threshold']),
        top_percent=100 * float(golden[f'{parameters}.quantile']),
        top_k=int(golden[f'{parameters}.num_selected']) if critic else None,
        slack=int(golden[f'{parameters}.slack']),
        min_steps=int(golden[f'{parameters}.min_steps']),
    )
    finder = TrajectoryFilter(dataset, config)
    masks = golden[f'{parameters}.critic.mask' if critic else f'{parameters}.critic_free.mask']
    assert masks.shape == (12, rows)
    assert masks.any(axis=1).sum() >= 8
    for number, (state, goal) in enumerate(zip(golden['s'], golden['g'], strict=True)):
        values = golden['values'][number]

        def value_fn(observations, goal, values=values):
            return values[observations[:, -1].astype(np.int64)]

        support = finder.query(
            np.append(state, 0), np.append(goal, 0), value_fn if critic else None
        )
        mask = np.zeros(rows, bool)
        mask[support.indices] = True
        label = golden['label'][number]
        assert np.array_equal(mask, masks[number]), f'query {number} ({label})'
        if critic:
            selected = golden[f'{parameters}.critic.selected'][number]
            assert support.episodes.tolist() == sorted(selected[selected >= 0])


@pytest.mark.parametrize('critic', [False, True])
def test_gcttt_keeps_ten_trajectories_by_value_by_default(critic):
    dataset = dataset_at([[(0, 0), (0, 0), *[(x, 0) for x in range(1, 14)]]] * 30)
    found = TrajectoryFilter(dataset, FilterConfig(variant='gcttt')).query(
        np.zeros(2),
        np.array([5.0, 0.0]),
        (lambda observations, goal: -abs(observations[:, 0] - 12.0)) if critic else None,
    )
    # Equal step counts: by steps, a quantile keeps all of them; by value, exactly ten.
    assert found.num_kept == (10 if critic else 30)
    assert found.episodes.tolist() == list(range(found.num_kept))


@given(st.lists(st.lists(st.integers(0, 3), max_size=6), max_size=6), st.randoms())
def test_first_row_of_the_smallest_value_of_each_trajectory(values, random):
    episodes = [number for number, group in enumerate(values) for _ in group]
    flat = [value for group in values for value in group]
    rows = [10 + 2 * number for number in range(len(flat))]
    order = list(range(len(rows)))
    random.shuffle(order)
    best = smallest_per_episode(
        np.array(episodes, np.int64)[order],
        np.array(rows, np.int64)[order],
        np.array(flat, np.float64)[order],
    )
    kept = [(number, group) for number, group in enumerate(values) if group]
    assert best.episodes.tolist() == [number for number, _ in kept]
    assert best.values.tolist() == [min(group) for _, group in kept]
    offsets = np.cumsum([0, *(len(group) for group in values)])
    assert best.rows.tolist() == [
        rows[offsets[number] + group.index(min(group))] for number, group in kept
    ]
