"""V is evaluated once per row, goal and value function."""

from metagcttt_core.retrieval.value_cache import ValueCache
import numpy as np
import pytest

from tests.core.builders import random_dataset

GOAL = np.zeros(2, np.float32)


class CountingValue:
    """Minus the distance to the goal; counts the rows it is asked for."""

    def __init__(self):
        self.rows = 0

    def __call__(self, observations, goal):
        self.rows += len(observations)
        return -np.linalg.norm(observations - goal, axis=1)


@pytest.fixture
def dataset():
    return random_dataset((6, 4, 5))


def test_values_equal_the_function_and_known_rows_are_not_asked_again(dataset):
    value, cache = CountingValue(), ValueCache(dataset)
    rows = np.array([3, 1, 7])
    expected = value(dataset.observations[rows], GOAL)
    value.rows = 0
    np.testing.assert_allclose(cache.values(value, GOAL, rows), expected, rtol=1e-6)
    np.testing.assert_allclose(cache.values(value, GOAL, rows[::-1]), expected[::-1], rtol=1e-6)
    assert value.rows == 3
    cache.values(value, GOAL, np.array([1, 2, 3]))
    assert value.rows == 4


def test_another_goal_or_function_is_evaluated_anew(dataset):
    first, second, cache = CountingValue(), CountingValue(), ValueCache(dataset)
    rows = np.arange(5)
    cache.values(first, GOAL, rows)
    cache.values(first, GOAL + 1, rows)
    cache.values(second, GOAL, rows)
    assert (first.rows, second.rows) == (10, 5)


def test_the_least_recently_used_pair_makes_room(dataset):
    value, cache = CountingValue(), ValueCache(dataset, capacity=2)
    rows = np.arange(4)
    goals = [GOAL, GOAL + 1, GOAL + 2]
    for goal in (goals[0], goals[1], goals[0], goals[2], goals[0]):
        cache.values(value, goal, rows)
    assert value.rows == 12  # three goals once each: goal 0 was kept
    cache.values(value, goals[1], rows)
    assert value.rows == 16


def test_prefetch_leaves_nothing_to_evaluate(dataset):
    value, cache = CountingValue(), ValueCache(dataset)
    cache.values(value, GOAL, np.array([2, 3]))
    assert cache.prefetch(value, GOAL)
    assert value.rows == dataset.num_rows
    cache.values(value, GOAL, np.arange(dataset.num_rows))
    assert value.rows == dataset.num_rows


def test_prefetch_stops_between_batches(dataset):
    value, cache = CountingValue(), ValueCache(dataset)
    assert not cache.prefetch(value, GOAL, should_stop=lambda: True)
    assert value.rows == 0


@pytest.mark.parametrize(
    ('value_fn', 'message'),
    [
        (lambda observations, goal: np.zeros(1), r'must return shape \(3,\), got \(1,\)'),
        (lambda observations, goal: np.full(len(observations), np.nan), 'non-finite'),
    ],
)
def test_bad_values_are_refused_and_not_remembered(value_fn, message, dataset):
    cache = ValueCache(dataset)
    for _ in range(2):
        with pytest.raises(ValueError, match=message):
            cache.values(value_fn, GOAL, np.arange(3))


def test_a_goal_is_complete_from_its_prefetch_until_it_makes_room(dataset):
    value, cache = CountingValue(), ValueCache(dataset, capacity=1)
    cache.values(value, GOAL, np.arange(4))
    assert not cache.is_complete(value, GOAL)
    assert not cache.prefetch(value, GOAL, lambda: True)
    assert not cache.is_complete(value, GOAL)
    cache.prefetch(value, GOAL)
    assert cache.is_complete(value, GOAL)
    assert not cache.is_complete(value, GOAL + 1)
    cache.values(value, GOAL + 1, np.arange(4))
    cache.values(value, GOAL, np.arange(4))
    assert not cache.is_complete(value, GOAL)
