"""Faults of sensors and logs are seen in the columns."""

from metagcttt_core import DatasetError, TrajectoryDataset
from metagcttt_core.data.inspection import inspect
import numpy as np
import pytest
from tests.core.builders import terminals_of


def dataset(observations: np.ndarray, actions: np.ndarray, lengths: list[int]):
    return TrajectoryDataset.from_arrays(observations, actions, terminals_of(lengths))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_sound_data_has_no_findings(rng):
    found = inspect(dataset(rng.normal(size=(100, 2)), rng.uniform(-0.9, 0.9, (100, 2)), [40, 60]))
    assert found.lengths.tolist() == [39, 59]
    assert found.repeated_rows == 0
    assert not any(column.at_limit for column in found.actions)
    for column in (*found.observations, *found.actions):
        assert (column.outliers, column.repeated, column.same_as) == (0, 0.0, None)
        assert not column.is_frozen


def test_data_without_transitions_is_refused():
    with pytest.raises(DatasetError, match='no transitions'):
        inspect(dataset(np.zeros((2, 1)), np.zeros((2, 1)), [1, 1]))


def test_frozen_and_doubled_columns_and_outliers_are_found(rng):
    observations = rng.uniform(0, 0.5, (50, 5))
    observations[:, [1, 4]] = 0.25  # one finding is enough
    observations[:, 3] = observations[:, 0]
    observations[7, 2] = 30.0
    found = inspect(dataset(observations, np.zeros((50, 1)), [50])).observations
    assert [column.is_frozen for column in found] == [False, True, False, False, True]
    assert [column.same_as for column in found] == [None, None, None, 0, None]
    assert [column.outliers for column in found] == [0, 0, 1, 0, 0]
    assert [column.repeated for column in found] == [0.0, 1.0, 0.0, 0.0, 1.0]
    assert found[2].percentiles[-1] == 30.0


def test_steps_that_change_nothing_are_counted_within_trajectories():
    """The last row of the first trajectory equals the first of the second: no step at all."""
    observations = np.array([[0.0], [1.0], [1.0], [1.0], [2.0], [2.0]])
    found = inspect(dataset(observations, np.zeros((6, 1)), [3, 3]))
    assert found.repeated_rows == 2
    assert found.observations[0].repeated == 0.5


def test_actions_that_are_never_taken_do_not_count():
    actions = np.array([[1.0], [0.5], [-1.0], [0.25], [0.25], [1.0]])
    [column] = inspect(dataset(np.arange(6.0)[:, None], actions, [3, 3])).actions
    assert column.percentiles[0] == 0.25
    assert column.at_limit == 0.25  # the first of four
    assert column.repeated == 0.5  # of 1 to 0.5 and 0.25 to 0.25


def test_rates_and_gaps_are_those_within_trajectories():
    """From the first trajectory to the second there is no step, whatever the time between."""
    times = np.array([0, 0.1, 0.2, 0.3, 0.7, 9.0, 9.1, 9.2, 9.3])
    data = TrajectoryDataset.from_arrays(
        np.arange(9.0)[:, None], np.zeros((9, 1)), terminals_of([5, 4]), {'time_s': times}
    )
    pace = inspect(data).pace
    assert pace.rate_hz == pytest.approx(10)
    assert (pace.gaps, pace.longest_row) == (1, 3)
    assert pace.longest_s == pytest.approx(0.4)
    assert inspect(dataset(np.zeros((3, 1)), np.zeros((3, 1)), [3])).pace is None
