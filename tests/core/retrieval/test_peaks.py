"""Rows of highest value: those that an evaluation of every row finds, with far fewer of them."""

from hypothesis import given
from hypothesis import strategies as st
from metagcttt_core import FilterConfig, TrajectoryDataset, TrajectoryFilter
from metagcttt_core.agents.networks import MLP
from metagcttt_core.retrieval import peaks
from metagcttt_core.retrieval.peaks import high_rows
import numpy as np
import pytest
import torch

from tests.core.builders import terminals_of


def best_of(rows, values, starts, stops, count):
    """(trajectory, its first highest row) of the `count` best, ties to the earlier."""
    found = []
    for number, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        own = np.flatnonzero((rows >= start) & (rows < stop))
        highest = values[own].max()
        found.append((-highest, number, rows[own][values[own] == highest].min()))
    return [(number, row) for _, number, row in sorted(found)[:count]]


@given(
    trajectories=st.lists(
        st.lists(st.integers(0, 5) | st.integers(0, 300), min_size=1, max_size=70),
        min_size=1,
        max_size=9,
    ),
    count=st.integers(1, 10),
)
def test_a_rough_function_is_searched_everywhere_it_matters(trajectories, count):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(peaks, '_EXHAUSTIVE_ROWS', 0)
        table = np.concatenate(trajectories).astype(np.float32)
        stops = np.cumsum([len(part) for part in trajectories])
        starts = stops - [len(part) for part in trajectories]
        rows, values = high_rows(lambda rows: table[rows], starts, stops, count)
    assert len(set(rows)) == len(rows)
    np.testing.assert_array_equal(values, table[rows])
    everywhere = np.arange(len(table))
    expected = best_of(everywhere, table, starts, stops, count)
    assert best_of(rows, values, starts, stops, count) == expected


def walks(count, length, seed):
    """States (count * length, 2) of smooth walks: 0.1 a step, as robots move."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(0, 7, size=(count, 1)) + rng.normal(0, 0.2, (count, length)).cumsum(1)
    steps = 0.1 * np.stack([np.cos(heading), np.sin(heading)], -1)
    return (rng.uniform(0, 20, size=(count, 1, 2)) + steps.cumsum(1)).reshape(-1, 2)


def cone(states):
    """Steps to (10, 10), discounted as a value is: with a kink where it is highest."""
    return (0.99 ** (10 * np.linalg.norm(states - 10, axis=1)) - 1) / 0.01


def network(states):
    mlp = MLP(2, (64, 64), 1, layer_norm=True, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        return mlp(torch.from_numpy(states / 10).float()).numpy()[:, 0]


@pytest.mark.parametrize('function', [cone, network])
@pytest.mark.parametrize('count', [1, 20, 100])
def test_a_smooth_function_is_evaluated_at_few_rows(function, count):
    starts = np.arange(100) * 500
    stops = starts + np.random.default_rng(0).integers(300, 501, size=100)
    for seed in range(3):
        states = walks(100, 500, seed)
        table = function(states).astype(np.float32)
        asked = []

        def value(rows, table=table, asked=asked):
            asked.append(len(rows))
            return table[rows]

        rows, values = high_rows(value, starts, stops, count)
        everywhere = np.concatenate([np.arange(*ends) for ends in zip(starts, stops, strict=True)])
        expected = best_of(everywhere, table[everywhere], starts, stops, count)
        assert best_of(rows, values, starts, stops, count) == expected
        assert sum(asked) == len(rows) < len(everywhere) / 2


def test_few_rows_are_all_evaluated_at_once():
    asked = []
    rows, values = high_rows(
        lambda rows: asked.append(rows) or -rows.astype(np.float32),
        *(np.array([0, 20]), np.array([20, 3000])),
        1,
    )
    assert len(asked) == 1
    np.testing.assert_array_equal(rows, np.arange(3000))
    np.testing.assert_array_equal(values, -np.arange(3000))


@pytest.mark.parametrize('variant', ['paper', 'gcttt', 'score_only'])
def test_queries_select_what_an_evaluation_of_every_row_selects(variant, monkeypatch):
    states = walks(100, 500, 0)
    dataset = TrajectoryDataset.from_arrays(
        states, np.zeros((len(states), 2)), terminals_of([500] * 100)
    )
    asked = []

    def value(observations, goal):
        asked.append(len(observations))
        return (0.99 ** (10 * np.linalg.norm(observations - goal, axis=1)) - 1) / 0.01

    config = FilterConfig(variant=variant, epsilon=8.0)
    query = np.array([9.0, 11.0]), np.array([12.0, 8.0])
    narrowed = TrajectoryFilter(dataset, config).query(*query, value)
    few = sum(asked)
    prefetched = TrajectoryFilter(dataset, config)
    prefetched.prefetch_values(value, query[1])
    asked.clear()
    monkeypatch.setattr(peaks, '_EXHAUSTIVE_ROWS', np.inf)
    everywhere = TrajectoryFilter(dataset, config).query(*query, value)
    assert 16_384 < sum(asked) > 2 * few
    assert narrowed == everywhere == prefetched.query(*query, value)
    assert len(narrowed.segments) > 1
