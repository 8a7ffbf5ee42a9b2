from metagcttt.policy.pilot import choose, Query, State
from metagcttt_core import make_agent, TTTConfig
import numpy as np
import pytest

AGENT = make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(8,))


def state(step: int = 0, **changes) -> State:
    values = {'episode_id': 1, 'step': step, 'observation': np.ones(2), 'ended': False}
    return State(**{**values, **changes})


def query(horizon: int | None = None, hold: bool = False, **changes) -> Query:
    return Query(
        query_id=7,
        episode_id=1,
        goal=np.zeros(2),
        seed=0,
        config=TTTConfig(horizon=horizon),
        hold=hold,
        expert=AGENT,
        **changes,
    )


def test_acts_with_the_expert() -> None:
    command = choose(state(), query(adapted=True), 2)
    np.testing.assert_array_equal(command.values, AGENT.act(np.ones(2), np.zeros(2)))
    assert (command.query_id, command.adapted) == (7, True)


@pytest.mark.parametrize(
    'nothing_to_do',
    [
        (state(), None),
        (state(episode_id=2), query()),
        (state(ended=True), query()),
        (state(), query(hold=True, adapting=True)),
    ],
    ids=['no goal', 'goal of another episode', 'episode ended', 'expert not ready'],
)
def test_action_is_zero_and_serves_no_query(nothing_to_do) -> None:
    command = choose(*nothing_to_do, 2)
    assert (command.values.tolist(), command.query_id) == ([0, 0], 0)


def test_action_for_a_faulty_state_is_zero() -> None:
    command = choose(state(observation=np.full(2, np.nan), fault='not finite'), query(), 2)
    assert (command.values.tolist(), command.query_id) == ([0, 0], 7)


def test_acts_while_adapting_unless_told_to_hold() -> None:
    assert choose(state(), query(adapting=True), 2).query_id == 7


def test_needs_adaptation_to_the_first_state_only() -> None:
    assert query().needs_adaptation(state())
    assert not query(adapted_at=0).needs_adaptation(state(step=500))
    assert not query(adapting=True).needs_adaptation(state())


def test_needs_adaptation_after_each_horizon() -> None:
    assert not query(horizon=10, adapted_at=5).needs_adaptation(state(step=14))
    assert query(horizon=10, adapted_at=5).needs_adaptation(state(step=15))


@pytest.mark.parametrize('unusable', [state(fault='bad'), state(ended=True), state(episode_id=2)])
def test_does_not_adapt_to_an_unusable_state(unusable: State) -> None:
    assert not query().needs_adaptation(unusable)
