from hypothesis import given
from hypothesis import strategies as st
from metagcttt.state_order import StateOrder

numbers = st.tuples(st.integers(0, 5), st.integers(0, 5))


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
