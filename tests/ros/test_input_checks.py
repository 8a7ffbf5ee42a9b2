from hypothesis import given
from hypothesis import strategies as st
from metagcttt.input_checks import Senders, StateOrder, vector_fault
import numpy as np
import pytest

numbers = st.tuples(st.integers(0, 5), st.integers(0, 5))


@pytest.mark.parametrize(
    ('values', 'fault'),
    [
        ([1.0, 2.0], ''),
        ([1e39, 0.0], 'the state is not finite: [1e+39, 0.0]'),
        ([1.0], 'the state has 1 values, 2 are needed'),
        ([], 'the state has 0 values, 2 are needed'),
        ([1.0, np.nan], 'the state is not finite: [1.0, nan]'),
        ([-np.inf, 0.0], 'the state is not finite: [-inf, 0.0]'),
    ],
)
def test_vector_fault(values: list[float], fault: str) -> None:
    assert vector_fault('the state', np.array(values, dtype=np.float64), 2) == fault


def taken(*states: tuple[int, int]) -> list[bool]:
    order = StateOrder()
    return [not order.refusal(*state) for state in states]


def test_states_in_order_are_taken_also_repeated_and_with_gaps() -> None:
    assert all(taken((1, 0), (1, 1), (1, 1), (1, 9), (2, 0), (7, 3)))


def test_older_state_is_refused_with_both_numbers() -> None:
    order = StateOrder()
    order.refusal(3, 10)
    expected = 'state 9 of episode 3 came after state 10 of episode 3'
    assert order.refusal(3, 9) == expected
    assert order.refusal(3, 11) == ''


def test_restarted_simulator_is_taken_at_its_third_state() -> None:
    assert taken((5, 40), (1, 0), (1, 1), (1, 2), (1, 3)) == [True, False, False, True, True]


def test_two_simulators_at_once_do_not_count_as_a_restart() -> None:
    states = [(5, 40), (1, 0), (5, 41), (1, 1), (5, 42), (1, 2), (5, 43), (1, 3)]
    assert taken(*states) == [True, False] * 4


def test_backward_states_do_not_count_as_a_restart() -> None:
    assert taken((5, 9), (5, 8), (5, 7), (5, 6), (5, 5)) == [True, False, False, False, False]


@given(st.lists(numbers, max_size=30))
def test_newest_state_is_taken_whatever_came_before(states: list[tuple[int, int]]) -> None:
    assert taken(*states, (6, 0))[-1]


def test_senders_are_forgotten_after_a_second_of_silence() -> None:
    senders = Senders()
    assert senders.count(0.0) == 0
    for instance, now_s in [(1, 0.0), (2, 0.3), (1, 0.6)]:
        senders.saw(instance, now_s)
    assert [senders.count(now_s) for now_s in (0.6, 1.3, 1.31, 1.6, 1.7)] == [2, 2, 1, 1, 0]
