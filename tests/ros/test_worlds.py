"""Which states and starts of episodes belong to the present, singly and in random sequences."""

from hypothesis import given
from hypothesis import strategies as st
from metagcttt.worlds import Moment, WorldOrder

WORLD, OTHER = 0xA, 0xB


def taken(*states: tuple[int, int], world_id: int = 0, restart_states: int = 3) -> list[bool]:
    """Which of the states, published one nanosecond apart, are taken."""
    order = WorldOrder(restart_states)
    return [not order.refuse_state(Moment(world_id, *s), ns) for ns, s in enumerate(states)]


def test_states_in_order_are_taken_also_repeated_and_with_gaps() -> None:
    assert all(taken((1, 0), (1, 1), (1, 1), (1, 9), (2, 0), (7, 3)))


def test_older_state_is_refused_with_both_moments() -> None:
    order = WorldOrder()
    order.refuse_state(Moment(WORLD, 3, 10), 0)
    expected = 'state 9 of episode 3 in world a came after state 10 of episode 3 in world a'
    assert order.refuse_state(Moment(WORLD, 3, 9), 1) == expected
    assert order.refuse_state(Moment(WORLD, 3, 11), 2) == ''


def test_source_without_identity_has_begun_again_at_its_third_older_state() -> None:
    assert taken((5, 40), (1, 0), (1, 1), (1, 2), (1, 3)) == [True, False, False, True, True]
    assert taken((5, 40), (1, 0), (1, 1), restart_states=1) == [True, True, True]


def test_time_of_a_world_with_identity_never_runs_backwards() -> None:
    older = [(1, n) for n in range(20)]
    assert taken((5, 40), *older, (5, 41), world_id=WORLD) == [True, *[False] * 20, True]


def test_two_simulators_at_once_do_not_count_as_a_restart() -> None:
    states = [(5, 40), (1, 0), (5, 41), (1, 1), (5, 42), (1, 2), (5, 43), (1, 3)]
    assert taken(*states) == [True, False] * 4


def test_backward_states_do_not_count_as_a_restart() -> None:
    assert taken((5, 9), (5, 8), (5, 7), (5, 6), (5, 5)) == [True, False, False, False, False]


def test_late_messages_of_a_world_that_is_over_are_refused() -> None:
    order = WorldOrder()
    order.refuse_state(Moment(WORLD, 9, 80), 100)
    assert order.refuse_start(Moment(OTHER, 1), 200) == ''
    assert order.refuse_state(Moment(WORLD, 9, 81), 150)
    assert order.refuse_start(Moment(WORLD, 9), 50)
    assert order.now == Moment(OTHER, 1, 0)
    assert order.num_worlds == 2


def test_world_whose_clock_is_behind_is_taken_once_it_goes_on() -> None:
    """It runs on another computer, or the clock was set back; waiting for it would take hours."""
    hour_ns = 3600 * 10**9
    order = WorldOrder()
    order.refuse_state(Moment(WORLD, 9, 80), hour_ns)
    assert order.refuse_start(Moment(OTHER, 1), 1)
    assert order.refuse_state(Moment(OTHER, 1, 0), 2)
    assert order.refuse_state(Moment(OTHER, 1, 0), 3)  # lockstep repeats it
    assert order.refuse_state(Moment(OTHER, 1, 1), 4) == ''
    assert order.refuse_state(Moment(OTHER, 1, 2), 5) == ''
    assert (order.now, order.num_worlds) == (Moment(OTHER, 1, 2), 2)


def test_late_messages_between_those_of_the_present_world_stay_refused() -> None:
    order = WorldOrder()
    order.refuse_state(Moment(WORLD, 9, 80), 100)
    order.refuse_state(Moment(OTHER, 1, 0), 200)
    for step in range(1, 9):
        assert order.refuse_state(Moment(WORLD, 9, 80 + step), 100 + step)
        assert order.refuse_state(Moment(OTHER, 1, step), 200 + step) == ''
    assert order.num_worlds == 2


def test_start_counts_once_before_or_after_the_first_states() -> None:
    for state_first in (False, True):
        order = WorldOrder()
        if state_first:
            order.refuse_state(Moment(WORLD, 1, 5), 20)
        assert order.refuse_start(Moment(WORLD, 1), 10) == ''
        assert 'was announced before' in order.refuse_start(Moment(WORLD, 1), 30)
        assert order.num_worlds == 1


def test_start_after_steps_of_the_same_episode_is_a_restart_without_identity() -> None:
    order = WorldOrder()
    order.refuse_start(Moment(0, 1), 1)
    order.refuse_state(Moment(0, 1, 7), 2)
    assert order.refuse_start(Moment(0, 1), 3) == ''
    assert (order.now, order.num_worlds) == (Moment(0, 1, 0), 2)


moments = st.builds(
    Moment, st.sampled_from([0, WORLD, OTHER]), st.integers(0, 4), st.integers(0, 4)
)
messages = st.lists(st.tuples(st.booleans(), moments, st.integers(0, 30)), max_size=40)


@given(messages, st.sampled_from([1, 3]))
def test_present_goes_forward_in_every_world(sent, restart_states: int) -> None:
    order = WorldOrder(restart_states)
    for is_start, moment, published_ns in sent:
        before, num_before = order.now, order.num_worlds
        if is_start:
            moment = moment._replace(step=0)
            refusal = order.refuse_start(moment, published_ns)
        else:
            refusal = order.refuse_state(moment, published_ns)
        if refusal:
            assert (order.now, order.num_worlds) == (before, num_before)
        elif before is not None and order.num_worlds == num_before:
            assert order.now.world_id == before.world_id
            assert order.now >= before
        elif before is not None:
            assert order.num_worlds == num_before + 1
            assert order.now == moment
            assert order.now.world_id == 0 or order.now.world_id != before.world_id


@given(messages, st.sampled_from([0xC, 0]), st.sampled_from([-50, 0, 50]), st.integers(0, 3))
def test_whoever_goes_on_alone_is_heard_whatever_came_before(
    sent, world_id: int, published_ns: int, repeats: int
) -> None:
    """No clock, no restart and no missed start leaves a source of states unheard."""
    order = WorldOrder()
    for is_start, moment, sent_ns in sent:
        (order.refuse_start if is_start else order.refuse_state)(moment, sent_ns)
    late = published_ns < 30 and (order.now or Moment(0, 0)).world_id == world_id == 0
    refusals = [
        order.refuse_state(Moment(world_id, 1, step), published_ns + step)
        for step in range(10)
        for _ in range(1 + repeats * bool(world_id))
    ]
    assert refusals[-1] == '' or late
    assert late or order.now == Moment(world_id, 1, 9)


@given(messages)
def test_newest_state_and_a_new_world_are_taken_whatever_came_before(sent) -> None:
    order = WorldOrder()
    for is_start, moment, published_ns in sent:
        (order.refuse_start if is_start else order.refuse_state)(moment, published_ns)
    assert order.refuse_state(Moment(order.now.world_id if order.now else 0, 9, 0), 31) == ''
    assert order.refuse_state(Moment(0xC, 1, 0), 31) == ''
