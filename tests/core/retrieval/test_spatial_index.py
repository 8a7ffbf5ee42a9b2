"""The grid index against a scan of all rows, at every scale of the data."""

from hypothesis import given, settings
from hypothesis import strategies as st
from metagcttt_core import FilterConfig, TrajectoryFilter
from metagcttt_core.retrieval import spatial_index
from metagcttt_core.retrieval.spatial_index import SpatialIndex
from metagcttt_core.retrieval.variants import smallest_per_episode
import numpy as np
import pytest

from tests.core.builders import random_dataset


def scan(observations, dims, scale, point, radius, *, strict=False):
    """Rows within the radius and their distances, by looking at every row."""
    offsets = (observations[:, list(dims)].astype(np.float64) - point) * (scale or 1.0)
    distances = np.sqrt((offsets**2).sum(axis=1))
    rows = np.flatnonzero(distances < radius if strict else distances <= radius)
    return rows, distances[rows]


def ascending(near):
    """Neighbours in the order of their rows."""
    order = np.argsort(near.rows)
    return near.rows[order], near.distances[order]


@settings(max_examples=3 * settings().max_examples)
@given(
    seed=st.integers(0, 10_000),
    dims=st.sampled_from([(0,), (1,), (0, 1), (2, 0), (0, 1, 2), (3, 1, 0, 2)]),
    spread=st.sampled_from([1e-3, 1.0, 30.0, 1e6]),
    offset=st.sampled_from([0.0, -1e3, 1e7]),
    radius=st.sampled_from([0.1, 1.0, 3.0, 50.0]),
    cell=st.sampled_from([0.05, 0.5, 7.0]),
    scaled=st.booleans(),
    strict=st.booleans(),
)
def test_ball_equals_a_scan(seed, dims, spread, offset, radius, cell, scaled, strict):
    rng = np.random.default_rng(seed)
    observations = (offset + spread * rng.normal(size=(60, 4))).astype(np.float32)
    scale = tuple(rng.uniform(0.2, 3, size=len(dims))) if scaled else None
    # Radii and cells grow with the data, so that balls are neither empty nor everything.
    radius, cell = radius * spread, cell * spread
    index = SpatialIndex(observations, dims, scale, cell)
    points = [
        observations[7, list(dims)].astype(np.float64),
        observations[:, list(dims)].mean(axis=0) + radius,
        observations[:, list(dims)].max(axis=0) + 0.7 * radius,
        observations[:, list(dims)].min(axis=0) - 100 * radius,
    ]
    for point in points:
        rows, distances = ascending(index.ball(point, radius, strict=strict))
        expected_rows, expected = scan(observations, dims, scale, point, radius, strict=strict)
        assert rows.tolist() == expected_rows.tolist()
        np.testing.assert_allclose(distances, expected, rtol=1e-12)
        assert rows.dtype == np.int64


@given(
    seed=st.integers(0, 10_000),
    dims=st.sampled_from([(0,), (1, 0), (0, 1, 2)]),
    rows=st.sampled_from([1, 60, 2000]),  # the kernel reads 512 at a time
    radius=st.sampled_from([0.1, 1.0, 50.0]),
    ties=st.booleans(),
    from_some_row=st.booleans(),
)
def test_nearest_per_episode_is_the_smallest_of_the_ball(
    seed, dims, rows, radius, ties, from_some_row
):
    rng = np.random.default_rng(seed)
    observations = rng.normal(size=(rows, 3)).astype(np.float32)
    if ties:
        observations = np.round(observations)
    episodes = np.sort(rng.integers(7, size=rows))
    scale = tuple(rng.uniform(0.2, 3, size=len(dims)))
    index = SpatialIndex(observations, dims, scale, 0.5, episodes)
    first_usable = rng.integers(rows, size=episodes[-1] + 1) if from_some_row else None
    point = rng.normal(size=len(dims))
    found = index.nearest_per_episode(point, radius, first_usable)
    if len(dims) > 2:
        assert found is None
        return
    near, distances = index.ball(point, radius)
    if first_usable is not None:
        usable = near >= first_usable[episodes[near]]
        near, distances = near[usable], distances[usable]
    for own, expected in zip(
        found, smallest_per_episode(episodes[near], near, distances), strict=True
    ):
        assert own.tolist() == expected.tolist()


@pytest.mark.parametrize('variant', ['paper', 'relevance_only', 'score_only'])
def test_filters_without_a_compiler_select_the_same(variant, monkeypatch):
    dataset = random_dataset([40] * 8, seed=3)
    tasks = dataset.observations[np.random.default_rng(0).integers(320, size=(20, 2))]
    config = FilterConfig(variant=variant, epsilon=0.7)
    found = [TrajectoryFilter(dataset, config).query(*task) for task in tasks]
    monkeypatch.setattr(spatial_index, 'kernels_if_any', lambda: None)
    assert [TrajectoryFilter(dataset, config).query(*task) for task in tasks] == found
    assert any(found)


@pytest.mark.parametrize('strict', [False, True])
def test_boundary_belongs_to_the_ball_unless_strict(strict):
    observations = np.array([[3, 4], [5, 0], [0, -5], [4, 4], [0, 0]], np.float32)
    index = SpatialIndex(observations, (0, 1), None, 0.5)
    rows, distances = ascending(index.ball(np.zeros(2), 5.0, strict=strict))
    assert rows.tolist() == ([4] if strict else [0, 1, 2, 4])
    assert distances.tolist() == ([0] if strict else [5, 5, 5, 0])


def test_duplicates_are_all_found_and_the_first_is_nearest():
    observations = np.tile(np.array([[1, 1], [2, 2]], np.float32), (4, 1))
    index = SpatialIndex(observations, (0, 1), None, 0.5)
    assert sorted(index.ball(np.ones(2), 0.1).rows) == [0, 2, 4, 6]
    assert index.nearest(np.array([1.9, 1.9])) == 1


def test_one_outlier_far_away_does_not_hide_the_rest():
    rng = np.random.default_rng(0)
    observations = rng.uniform(0, 5, size=(200, 2)).astype(np.float32)
    observations[17] = (-3e9, 2e9)
    index = SpatialIndex(observations, (0, 1), None, 0.5)
    for point in rng.uniform(0, 5, size=(20, 2)):
        expected, _ = scan(observations, (0, 1), None, point, 1.0)
        assert len(expected)
        assert sorted(index.ball(point, 1.0).rows) == expected.tolist()
    assert index.nearest(np.array([-3.1e9, 2e9])) == 17


def test_a_wide_ball_over_a_fine_grid_visits_only_columns_that_hold_rows():
    corners = np.array([[0, 0], [1e4, 0], [0, 1e4], [1e4, 1e4]], np.float32)
    index = SpatialIndex(corners, (0, 1), None, 1e-5)  # a thousand million columns
    assert index.nearest(np.array([5e3 + 1, 5e3 + 1])) == 3
    assert len(index.ball(np.array([5e3, 5e3]), 9e3).rows) == 4
