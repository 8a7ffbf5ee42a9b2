"""SupportSet: its counts and its train and test split."""

from dataclasses import FrozenInstanceError, replace

from hypothesis import given
from hypothesis import strategies as st
from metagcttt_core import SupportSet
import numpy as np
import pytest

ROWS = st.lists(st.integers(0, 10_000), unique=True, max_size=300).map(sorted)
FRACTIONS = st.floats(0.01, 0.99)
SEEDS = st.integers(0, 2**32)


def support_of(rows) -> SupportSet:
    return SupportSet(
        indices=np.array(rows, np.int64),
        segments=[(0, 3), (7, 9)],
        episodes=np.array([0, 2]),
        scores=np.array([-0.5, -0.25]),
        num_relevant=5,
        num_scored=3,
        milliseconds=1.5,
    )


def test_counts():
    support = support_of([0, 1, 2, 7, 8])
    assert (support.num_relevant, support.num_dropped, support.num_kept) == (5, 2, 2)
    assert support.num_transitions == len(support) == 5
    assert support
    assert not support_of([])


def test_equal_supports_may_have_taken_different_times():
    support = support_of([1, 2])
    assert support == replace(support_of([1, 2]), milliseconds=9.0)
    assert support != support_of([1, 3])
    assert support != replace(support, scores=np.array([-0.5, -0.3]))
    assert support != replace(support, segments=[(0, 3)])
    assert support != replace(support, num_relevant=6)
    assert support != 'a support'


def test_support_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        support_of([1]).num_relevant = 3


@given(ROWS, FRACTIONS, st.none() | st.integers(1, 200), SEEDS)
def test_split_is_disjoint_and_takes_nothing_from_elsewhere(rows, fraction, max_test, seed):
    train, test = support_of(rows).split(fraction, max_test, seed)
    ours, held_out = set(train.indices.tolist()), set(test.indices.tolist())
    assert not ours & held_out
    assert ours | held_out <= set(rows)
    if max_test is None:
        assert ours | held_out == set(rows)
    for part in (train, test):
        assert part.indices.dtype == np.int64
        assert (np.diff(part.indices) > 0).all()
        assert (part.segments, part.num_relevant, part.num_scored) == ([(0, 3), (7, 9)], 5, 3)


@given(ROWS, FRACTIONS, st.none() | st.integers(1, 200), SEEDS)
def test_split_sizes(rows, fraction, max_test, seed):
    train, test = support_of(rows).split(fraction, max_test, seed)
    held_out = round(fraction * len(rows))
    if len(rows) < 2:
        held_out = 0
    else:
        held_out = min(max(held_out, 1), len(rows) - 1)
    assert len(train) == len(rows) - held_out
    assert len(test) == (held_out if max_test is None else min(held_out, max_test))


@given(ROWS, SEEDS)
def test_thinning_only_drops_from_the_test_split(rows, seed):
    train, test = support_of(rows).split(0.5, None, seed)
    same_train, thinned = support_of(rows).split(0.5, 3, seed)
    assert np.array_equal(same_train.indices, train.indices)
    assert set(thinned.indices.tolist()) <= set(test.indices.tolist())


@pytest.mark.parametrize(
    ('size', 'expected'), [(0, (0, 0)), (1, (1, 0)), (2, (1, 1)), (10, (8, 2)), (1000, (800, 128))]
)
def test_default_split_holds_out_a_fifth_and_at_most_128(size, expected):
    train, test = support_of(range(size)).split()
    assert (len(train), len(test)) == expected


def test_split_depends_on_the_seed_alone():
    support = support_of(range(100))
    first, again, other = (support.split(seed=seed)[1].indices for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    generator = support.split(seed=np.random.default_rng(1))[1].indices
    assert np.array_equal(generator, first)


def test_every_transition_is_as_likely_to_be_held_out():
    held_out = np.zeros(20)
    for seed in range(1000):
        held_out[support_of(range(20)).split(0.25, None, seed)[1].indices] += 1
    assert abs(held_out - 250).max() < 60


@pytest.mark.parametrize('fraction', [0.0, 1.0, -0.2, 1.5, float('nan')])
def test_fraction_outside_zero_to_one_is_refused(fraction):
    with pytest.raises(ValueError, match=rf'test_fraction must be in \(0, 1\), got {fraction}'):
        support_of(range(10)).split(fraction)


def test_without_rows_removes_the_excluded_only():
    excluded = np.zeros(10, bool)
    excluded[[2, 8]] = True
    assert support_of([0, 1, 2, 7, 8]).without_rows(excluded).indices.tolist() == [0, 1, 7]
