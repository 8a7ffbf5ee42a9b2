"""The baseline that the retrieval benchmark compares with selects the same rows."""

from metagcttt_core import TrajectoryDataset, TrajectoryFilter
from metagcttt_tools.benchmarks.retrieval import enlarged, in_batches
from metagcttt_tools.benchmarks.scan import scan
from metagcttt_tools.common.results import markdown_table
import numpy as np
import pytest
from tests.tools.tables import squeezed


@pytest.fixture(scope='module')
def dataset():
    rng = np.random.default_rng(0)
    observations = rng.normal(0, 0.5, size=(30, 40, 2)).cumsum(axis=1).reshape(-1, 2)
    terminals = np.zeros(len(observations), bool)
    terminals[39::40] = True
    return TrajectoryDataset.from_arrays(observations, np.zeros_like(observations), terminals)


def minus_distance(observations, goal):
    return -np.linalg.norm(observations - goal, axis=1)


@pytest.mark.parametrize('values', [None, minus_distance])
def test_scan_and_index_select_the_same_rows(values, dataset):
    trajectory_filter = TrajectoryFilter(dataset)
    rng = np.random.default_rng(1)
    selected = 0
    for state, goal in dataset.observations[rng.integers(dataset.num_rows, size=(50, 2))]:
        expected = scan(dataset, state, goal, values)
        support = trajectory_filter.query(state, goal, values)
        assert support.indices.tolist() == expected.tolist()
        selected += len(expected)
    assert selected > 0


def test_enlarged_data_keep_trajectories_whole(dataset):
    larger, smaller = enlarged(dataset, 3, seed=0), enlarged(dataset, 0.5, seed=0)
    assert (larger.num_episodes, larger.num_rows) == (90, 3600)
    assert np.abs(larger.observations[:1200] - dataset.observations).max() < 0.5
    assert np.array_equal(smaller.observations, dataset.observations[:600])


def test_values_in_batches_equal_all_at_once(dataset):
    goal = dataset.observations[7]
    batches = in_batches(minus_distance, dataset, goal, batch_rows=100)
    assert np.array_equal(batches, minus_distance(dataset.observations, goal))


def test_table_aligns_names_and_values():
    table = squeezed(
        markdown_table([{'dataset': 'a', 'rows': 1001000, 'ms': 0.98765, 'scan': 12345.6}])
    )
    assert table.splitlines()[0] == '| dataset | rows | ms | scan |'
    assert table.splitlines()[2] == '| a | 1,001,000 | 0.988 | 12,346 |'
