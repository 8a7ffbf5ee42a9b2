from hypothesis import given
from hypothesis import strategies as st
from metagcttt.goal_in_force import Goal
from metagcttt.policy.decision import Command, decide, Progress, Pursuit, State
from metagcttt_core import Adaptation, make_agent, TTTConfig
import numpy as np
import pytest

AGENT = make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(8,))
GOAL = Goal(query_id=7, episode_id=1, observation=np.zeros(2), xy=(0.0, 0.0), seed=0)
ADAPTED = Adaptation(AGENT, best_step=3)


def state(step: int = 0, **changes) -> State:
    values = {'episode_id': 1, 'step': step, 'observation': np.ones(2), 'ended': False}
    return State(**{**values, **changes})


def pursuit(horizon: int | None = None, hold: bool = False, **changes) -> Pursuit:
    values = {'goal': GOAL, 'adaptation': Adaptation(AGENT, reason='no state yet')}
    return Pursuit(config=TTTConfig(horizon=horizon), hold=hold, **{**values, **changes})


def test_acts_with_the_expert() -> None:
    command = decide(state(), pursuit(adaptation=ADAPTED), '', 2)
    np.testing.assert_array_equal(command.values, AGENT.act(np.ones(2), np.zeros(2)))
    assert (command.query_id, command.adapted, command.cause) == (7, True, '')


@pytest.mark.parametrize(
    ('nothing_to_do', 'reason'),
    [
        ((state(), None), 'no goal'),
        ((state(episode_id=2), pursuit()), 'the goal is for episode 1, not 2'),
        ((state(ended=True), pursuit()), 'episode 1 has ended'),
        ((state(), pursuit(hold=True, adapting=True)), 'waiting for the expert'),
    ],
)
def test_action_is_zero_and_serves_no_goal(nothing_to_do, reason: str) -> None:
    command = decide(*nothing_to_do, '', 2)
    assert (command.values.tolist(), command.query_id) == ([0, 0], 0)
    assert (command.cause, command.reason) == ('idle', reason)


def test_action_for_a_faulty_state_is_zero() -> None:
    faulty = state(observation=np.full(2, np.nan), fault='not finite')
    command = decide(faulty, pursuit(), '', 2)
    assert (command.values.tolist(), command.query_id) == ([0, 0], 7)
    assert (command.cause, command.reason) == ('unsafe', 'not finite')


def test_acts_while_adapting_unless_told_to_hold() -> None:
    assert decide(state(), pursuit(adapting=True), '', 2).query_id == 7


def test_needs_adaptation_to_the_first_state_only() -> None:
    assert pursuit().needs_adaptation(state())
    assert not pursuit(adapted_at=0).needs_adaptation(state(step=500))
    assert not pursuit(adapting=True).needs_adaptation(state())


def test_needs_adaptation_after_each_horizon() -> None:
    assert not pursuit(horizon=10, adapted_at=5).needs_adaptation(state(step=14))
    assert pursuit(horizon=10, adapted_at=5).needs_adaptation(state(step=15))


@pytest.mark.parametrize('unusable', [state(fault='bad'), state(ended=True), state(episode_id=2)])
def test_does_not_adapt_to_an_unusable_state(unusable: State) -> None:
    assert not pursuit().needs_adaptation(unusable)


def test_progress_of_a_superseded_adaptation_is_its_own() -> None:
    work = pursuit()
    superseded, work.progress = work.progress, Progress()
    superseded(5, {})
    assert (superseded.steps_done, work.progress.steps_done) == (5, 0)


# --- for every state, goal and safety reason -----------------------------------------------------


class Scripted:
    """A policy with one answer, which counts how often it is asked."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values
        self.num_asked = 0

    def act(self, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
        self.num_asked += 1
        return self.values


episodes = st.integers(1, 3)
reasons = st.sampled_from(['', '', 'disabled by the service enable', 'no state for 0.6 s'])
states = st.builds(
    State,
    episode_id=episodes,
    step=st.integers(0, 9),
    observation=st.just(np.ones(2)),
    ended=st.booleans(),
    fault=st.sampled_from(['', '', 'the state has 0 values, 2 are needed']),
)
outputs = st.lists(
    st.floats(-1, 1) | st.sampled_from([np.nan, np.inf, 0.5]), min_size=2, max_size=2
).map(np.array)
pursuits = st.none() | st.builds(
    Pursuit,
    goal=st.builds(
        Goal,
        query_id=st.integers(1, 5),
        episode_id=episodes,
        observation=st.just(np.zeros(2)),
        xy=st.just((0.0, 0.0)),
        seed=st.just(0),
    ),
    config=st.just(TTTConfig()),
    hold=st.booleans(),
    adaptation=st.builds(Adaptation, agent=outputs.map(Scripted), best_step=st.integers(0, 2)),
    adapting=st.booleans(),
)


def decided(state: State, work: Pursuit | None, unsafe: str) -> tuple[Command, int]:
    """The command, and how often the policy was asked for it."""
    command = decide(state, work, unsafe, 2)
    return command, work.adaptation.agent.num_asked if work else 0


@given(states, pursuits, reasons.filter(bool))
def test_robot_stands_still_for_every_safety_reason(state, work, unsafe: str) -> None:
    command, num_asked = decided(state, work, unsafe)
    assert not command.values.any()
    assert not command.adapted
    assert (command.cause, command.reason, num_asked) == ('unsafe', unsafe, 0)


@given(states, pursuits, reasons)
def test_robot_moves_only_in_a_usable_running_state_of_the_goal_s_episode(
    state, work, unsafe: str
) -> None:
    command, num_asked = decided(state, work, unsafe)
    moving = command.cause == ''
    assert moving or not command.values.any()
    if moving:
        assert work is not None
        assert (state.episode_id, state.ended) == (work.goal.episode_id, False)
        assert not (unsafe or state.fault or (work.hold and work.adapting))
        assert command.values is work.adaptation.agent.values
        assert command.adapted == work.adaptation.accepted
    assert num_asked == (command.cause in ('', 'unusable'))


@given(states, pursuits, reasons)
def test_command_is_finite_names_its_goal_and_says_why_it_is_zero(
    state, work, unsafe: str
) -> None:
    command, _ = decided(state, work, unsafe)
    assert command.values.shape == (2,)
    assert np.isfinite(command.values).all()
    assert bool(command.reason) == bool(command.cause)
    serves = work is not None and not work.idle_reason(state)
    assert command.query_id == (work.goal.query_id if serves else 0)
