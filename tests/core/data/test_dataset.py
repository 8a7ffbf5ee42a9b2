"""TrajectoryDataset: layout, sampling and what it refuses."""

from hypothesis import given
from hypothesis import strategies as st
from metagcttt_core import DatasetError, TrajectoryDataset
import numpy as np
import pytest
from tests.core.builders import dataset_at, random_dataset, terminals_of

LENGTHS = st.lists(st.integers(1, 7), min_size=1, max_size=8)


def arrays(rows: int = 6, **changes) -> dict[str, np.ndarray]:
    """Valid arguments of `from_arrays` with some of them replaced."""
    rng = np.random.default_rng(0)
    return {
        'observations': rng.normal(size=(rows, 2)),
        'actions': rng.uniform(-1, 1, size=(rows, 3)),
        'terminals': terminals_of([2, rows - 2]),
        **changes,
    }


def with_value(array: np.ndarray, row: int, value: float) -> np.ndarray:
    changed = np.array(array, dtype=np.float64)
    changed[row] = value
    return changed


def test_layout_of_ragged_trajectories():
    dataset = random_dataset([4, 1, 3], obs_dim=5, act_dim=2)
    assert dataset.episode_starts.tolist() == [0, 4, 5]
    assert dataset.episode_ends.tolist() == [3, 4, 7]
    assert dataset.episode_starts.dtype == dataset.episode_ends.dtype == np.int64
    assert (dataset.num_rows, dataset.num_episodes, dataset.num_transitions) == (8, 3, 5)
    assert (dataset.obs_dim, dataset.act_dim) == (5, 2)
    assert repr(dataset) == 'TrajectoryDataset(3 trajectories, 8 rows, obs_dim=5, act_dim=2)'


def test_float32_rows_are_kept_without_a_copy():
    given_rows = arrays(observations=np.zeros((6, 2), np.float32))
    dataset = TrajectoryDataset.from_arrays(**given_rows)
    assert np.shares_memory(dataset.observations, given_rows['observations'])


@pytest.mark.parametrize('dtype', [np.float64, np.float16, np.int32, np.uint8])
def test_other_numbers_become_float32(dtype):
    values = np.arange(12).reshape(6, 2)
    dataset = TrajectoryDataset.from_arrays(**arrays(observations=values.astype(dtype)))
    assert dataset.observations.dtype == np.float32
    assert np.array_equal(dataset.observations, values)


@pytest.mark.parametrize('dtype', [bool, np.float32, np.float64, np.int64, np.uint8])
def test_terminals_may_be_booleans_or_zeros_and_ones(dtype):
    flags = terminals_of([2, 4])
    dataset = TrajectoryDataset.from_arrays(**arrays(terminals=flags.astype(dtype)))
    assert dataset.terminals.dtype == np.bool_
    assert np.array_equal(dataset.terminals, flags)


@given(LENGTHS)
def test_every_row_belongs_to_the_trajectory_that_contains_it(lengths):
    dataset = random_dataset(lengths)
    expected = [number for number, length in enumerate(lengths) for _ in range(length)]
    assert dataset.episode_of(np.arange(sum(lengths))).tolist() == expected


@given(LENGTHS)
def test_transition_rows_are_all_rows_but_the_last_of_each_trajectory(lengths):
    dataset = random_dataset(lengths)
    expected = [row for row in range(sum(lengths)) if not dataset.terminals[row]]
    assert dataset.num_transitions == len(expected)
    assert dataset.transition_rows(np.arange(len(expected))).tolist() == expected


@given(LENGTHS.filter(lambda lengths: max(lengths) > 1), st.integers(0, 2**32))
def test_sampled_transitions_always_have_a_successor(lengths, seed):
    dataset = random_dataset(lengths)
    rows = dataset.sample_transitions(200, np.random.default_rng(seed))
    assert rows.shape == (200,)
    assert not dataset.terminals[rows].any()
    assert (dataset.episode_of(rows) == dataset.episode_of(rows + 1)).all()


def test_sampling_transitions_is_uniform():
    dataset = random_dataset([5, 1, 2, 3])
    rows = dataset.sample_transitions(70_000, np.random.default_rng(1))
    counts = np.bincount(rows, minlength=dataset.num_rows)[~dataset.terminals]
    chi_square = ((counts - 10_000) ** 2 / 10_000).sum()
    assert chi_square < 22.5  # 99.9 percent quantile at 6 degrees of freedom


def test_sampling_repeats_with_the_seed():
    dataset = random_dataset()
    first, second, other = (
        dataset.sample_transitions(50, np.random.default_rng(seed)) for seed in (3, 3, 4)
    )
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_sampling_from_single_states_is_refused():
    dataset = dataset_at([[(0, 0)], [(1, 1)]])
    with pytest.raises(DatasetError, match='no transitions, every trajectory is a single state'):
        dataset.sample_transitions(1, np.random.default_rng(0))


@pytest.mark.parametrize('name', ['observations', 'actions'])
@pytest.mark.parametrize(
    ('values', 'message'),
    [
        (np.zeros(6), r'must have shape \(rows, dimensions\), got \(6,\)'),
        (np.zeros((6, 2, 2)), r'must have shape \(rows, dimensions\), got \(6, 2, 2\)'),
        (np.zeros((6, 0)), r'must have shape \(rows, dimensions\), got \(6, 0\)'),
        (np.zeros((6, 2), complex), 'must hold real numbers, got dtype complex128'),
        (np.full((6, 2), 'x'), 'must hold real numbers, got dtype <U1'),
        (np.zeros((6, 2), object), 'must hold real numbers, got dtype object'),
        (np.zeros((6, 2), bool), 'must hold real numbers, got dtype bool'),
    ],
)
def test_wrong_rank_or_type_is_refused_by_name(name, values, message):
    with pytest.raises(DatasetError, match=f'^dataset: {name} {message}'):
        TrajectoryDataset.from_arrays(**arrays(**{name: values}))


@pytest.mark.parametrize('name', ['observations', 'actions'])
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_non_finite_value_is_refused_with_its_row(name, value, dtype):
    values = with_value(arrays()[name], 4, value).astype(dtype)
    with pytest.raises(DatasetError, match=f'{name} is {value} in row 4; every value must be'):
        TrajectoryDataset.from_arrays(**arrays(**{name: values}))


def test_first_of_several_non_finite_rows_is_named():
    values = with_value(with_value(arrays()['actions'], 5, np.inf), 3, np.nan)
    with pytest.raises(DatasetError, match='actions is nan in row 3'):
        TrajectoryDataset.from_arrays(**arrays(actions=values))


def test_non_finite_row_is_found_beyond_the_first_chunk(monkeypatch):
    monkeypatch.setattr('metagcttt_core.data.values._CHUNK_ROWS', 2)
    values = with_value(arrays()['observations'], 5, np.nan)
    with pytest.raises(DatasetError, match='observations is nan in row 5'):
        TrajectoryDataset.from_arrays(**arrays(observations=values))


def test_double_beyond_float32_is_refused():
    values = with_value(arrays()['observations'], 2, 1e300)
    with pytest.raises(DatasetError, match=r'observations is 1e\+300 in row 2'):
        TrajectoryDataset.from_arrays(**arrays(observations=values))


@pytest.mark.parametrize(
    ('terminals', 'message'),
    [
        ([0, 1, 0, 0, 0.5, 1], 'terminals must hold 0 or 1, got 0.5 in row 4'),
        ([0, 1, np.nan, 0, 0, 1], 'terminals must hold 0 or 1, got nan in row 2'),
        ([0, 2, 0, 0, 0, 1], 'terminals must hold 0 or 1, got 2 in row 1'),
        ([0, -1, 0, 0, 0, 1], 'terminals must hold 0 or 1, got -1 in row 1'),
        (['a'] * 6, 'terminals must hold booleans or 0 and 1, got dtype <U1'),
        (np.ones((6, 1)), r'terminals must have shape \(rows,\), got \(6, 1\)'),
        ([0, 1, 0, 0, 0, 0], r'terminals is false on the last row \(5\)'),
        ([0] * 6, r'terminals is false on the last row \(5\)'),
        ([0, 1, 0, 0, 1], 'terminals has 5 rows but observations has 6'),
    ],
)
def test_wrong_terminals_are_refused(terminals, message):
    with pytest.raises(DatasetError, match=message):
        TrajectoryDataset.from_arrays(**arrays(terminals=np.array(terminals)))


def test_mismatched_actions_are_refused():
    with pytest.raises(DatasetError, match='actions has 4 rows but observations has 6'):
        TrajectoryDataset.from_arrays(**arrays(actions=np.zeros((4, 3))))


def test_no_rows_are_refused():
    with pytest.raises(DatasetError, match='observations has no rows'):
        TrajectoryDataset.from_arrays(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool))


@pytest.mark.parametrize(
    ('extra', 'message'),
    [
        (np.zeros((5, 2)), 'qpos has 5 rows but observations has 6'),
        (np.float32(3), 'qpos has a scalar but observations has 6'),
        (with_value(np.zeros((6, 2)), 1, np.nan), 'qpos is nan in row 1'),
        (with_value(np.zeros(6), 3, np.inf), 'qpos is inf in row 3'),
        (np.array([{}] * 6), 'qpos holds Python objects'),
    ],
)
def test_wrong_extra_is_refused_by_name(extra, message):
    with pytest.raises(DatasetError, match=message):
        TrajectoryDataset.from_arrays(**arrays(), extras={'qpos': extra})


def test_extras_of_other_types_are_kept():
    extras = {'step': np.arange(6), 'tag': np.full(6, 'x')}
    dataset = TrajectoryDataset.from_arrays(**arrays(), extras=extras)
    assert dataset.extras['step'].tolist() == list(range(6))
    assert dataset.extras['tag'].tolist() == ['x'] * 6
