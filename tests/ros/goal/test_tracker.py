"""The life of goals, in single cases and over random sequences of inputs."""

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import invariant, rule, RuleBasedStateMachine
from metagcttt.goal.goals import GoalCatalog, RobotState, Verdict
from metagcttt.goal.tracker import (
    Accepted,
    Ended,
    GoalRequest,
    GoalTracker,
    Ignored,
    Now,
    Rejected,
)
from metagcttt.worlds import Moment
from metagcttt_core import TrajectoryFilter
import numpy as np
import pytest
from sim_bridge import describe_environment
from tests.ros.maze_walks import maze_walks

START = Now(100.0, 0.0)
FREE, ALSO_FREE, IN_WALL = (4.0, 0.0), (0.0, 4.0), (8.0, 0.0)
CATALOG = GoalCatalog(
    describe_environment('pointmaze-medium-v0'),
    TrajectoryFilter(maze_walks('pointmaze-medium-v0')),
)


@pytest.fixture
def tracker() -> GoalTracker:
    return GoalTracker(CATALOG, START)


def to(xy=FREE, **fields) -> GoalRequest:
    return GoalRequest(seed=0, **{'xy': xy, 'frame_id': 'map', **fields})


def see(tracker: GoalTracker, episode_id: int, step: int = 0, xy=(0.0, 0.0), now_ns=0, **flags):
    state = RobotState(episode_id, step, xy, **flags)
    return tracker.on_state(state, now_ns or 10 * step, START, tolerance_m=1.0, max_steps=50)


def begin(tracker: GoalTracker, episode_id: int, published_ns: int, task=None, world_id: int = 0):
    return tracker.on_episode(Moment(world_id, episode_id), published_ns, START, task)


def kinds(changes) -> list[str]:
    return [
        f'{type(change).__name__} {change.verdict.error}'
        if isinstance(change, Ended | Rejected)
        else f'Accepted {change.goal.query_id}'
        for change in changes
        if not isinstance(change, Ignored)
    ]


def test_newer_goal_ends_the_one_before_first(tracker: GoalTracker) -> None:
    see(tracker, 1)
    assert kinds(tracker.request(to(FREE), START)) == ['Accepted 1']
    assert kinds(tracker.request(to(ALSO_FREE), START)) == ['Ended PREEMPTED', 'Accepted 2']
    assert kinds(tracker.request(to(IN_WALL), START)) == ['Rejected IN_WALL']
    assert tracker.goal.query_id == 2


@pytest.mark.parametrize('by', ['state', 'event'])
def test_end_by_a_new_episode_has_the_last_step_of_the_goal_s_own(
    tracker: GoalTracker, by: str
) -> None:
    see(tracker, 1, step=3)
    tracker.request(to(), START)
    see(tracker, 1, step=8)
    [ended] = see(tracker, 2, now_ns=10**9) if by == 'state' else begin(tracker, 2, 10**9)
    assert (ended.verdict, ended.step) == (Verdict('NEW_EPISODE', 'episode 2 began'), 8)
    assert ended.goal.first_step == 3


def test_goal_for_an_announced_episode_begins_with_its_first_step(tracker: GoalTracker) -> None:
    see(tracker, 1, step=30)
    begin(tracker, 2, 10**9)
    assert tracker.state is None
    [accepted] = tracker.request(to(), START)
    assert (accepted.goal.episode_id, accepted.goal.first_step) == (2, 0)
    assert (
        kinds(see(tracker, 1, step=31, xy=FREE)) == []
    )  # of the episode before, still on its way
    assert kinds(see(tracker, 2, step=1, xy=FREE, now_ns=10**9)) == ['Ended NONE']


def test_restarted_simulator_is_the_newest_episode(tracker: GoalTracker) -> None:
    see(tracker, 3, step=9)
    begin(tracker, 1, 10**9)
    [accepted] = tracker.request(to(), START)
    assert accepted.goal.episode_id == 1


def test_latched_event_from_before_the_newest_state_is_ignored(tracker: GoalTracker) -> None:
    see(tracker, 3, step=9)
    tracker.request(to(), START)
    assert kinds(begin(tracker, 1, 89, to(ALSO_FREE, is_task=True))) == []
    assert tracker.goal.episode_id == 3


def test_steps_of_a_task_count_from_the_start_of_the_episode(tracker: GoalTracker) -> None:
    see(tracker, 1, step=30)  # which came before the event
    task = to(observation=np.array(FREE), frame_id='', episode_id=1, is_task=True)
    [accepted] = begin(tracker, 1, 0, task)
    assert accepted.goal.first_step == 0
    assert kinds(see(tracker, 1, step=50)) == ['Ended TIMED_OUT']


def lost(tracker: GoalTracker, steady_s: float, clock_s: float, has_source: bool = True) -> str:
    now = Now(100.0 + steady_s, clock_s)
    changes = tracker.on_time(now, has_source=has_source, timeout_s=1.0, partner_timeout_s=60.0)
    return changes[0].verdict.reason if changes else ''


def test_lockstep_goal_is_lost_with_its_source_or_its_episode(tracker: GoalTracker) -> None:
    see(tracker, 1)
    tracker.request(to(), START)
    assert not lost(tracker, 50.0, 50.0)
    assert not lost(tracker, 51.0, 51.0, has_source=False)
    assert lost(tracker, 51.5, 51.0, has_source=False) == 'no state of episode 1 for 1.5 s'
    tracker.request(to(episode_id=7), START)
    assert lost(tracker, 53.0, 53.0) == 'no state of episode 7 for 3.0 s'


def test_goal_for_a_future_episode_leaves_the_present_as_it_is(tracker: GoalTracker) -> None:
    see(tracker, 1, step=3)
    tracker.request(to(), START)
    changes = tracker.request(to(episode_id=1000), START)
    assert kinds(changes) == ['Ended PREEMPTED', 'Accepted 2']
    assert tracker.state is None
    assert kinds(see(tracker, 1, step=4, xy=FREE)) == []  # not its episode
    assert lost(tracker, 1.5, 1.5) == 'no state of episode 1000 for 1.5 s'
    [accepted] = tracker.request(to(), START)
    assert (accepted.goal.episode_id, accepted.goal.first_step) == (1, 4)
    assert kinds(see(tracker, 1, step=5, xy=FREE)) == ['Ended NONE']


def test_goal_ends_with_its_world_although_the_next_has_the_same_numbers(
    tracker: GoalTracker,
) -> None:
    see(tracker, 1, step=3, world_id=0xA)
    tracker.request(to(), START)
    [ended] = see(tracker, 1, step=3, xy=FREE, now_ns=40, world_id=0xB)
    reason = 'the simulator was started again: episode 1 began'
    assert ended.verdict == Verdict('NEW_EPISODE', reason)
    [accepted] = tracker.request(to(), START)
    assert accepted.goal.world_id == 0xB
    assert kinds(see(tracker, 1, step=9, xy=FREE, now_ns=35, world_id=0xA)) == []
    assert tracker.goal is accepted.goal


def test_goal_may_wait_for_a_world_that_is_named(tracker: GoalTracker) -> None:
    see(tracker, 1, step=3, world_id=0xA)
    assert kinds(tracker.request(to(world_id=0xB), START)) == ['Rejected EPISODE_OVER']
    tracker.request(to(episode_id=1, world_id=0xB), START)
    assert kinds(see(tracker, 1, step=4, xy=FREE, world_id=0xA)) == []
    assert kinds(begin(tracker, 1, 50, world_id=0xB)) == []
    assert kinds(see(tracker, 1, xy=FREE, now_ns=60, world_id=0xB)) == ['Ended NONE']


def test_lockstep_goal_ends_when_the_policy_is_gone(tracker: GoalTracker) -> None:
    see(tracker, 1)
    tracker.request(to(), START)

    def ends(after_s: float) -> list[str]:
        now = Now(100.0 + after_s, 0.0)
        return kinds(tracker.on_time(now, has_source=True, timeout_s=9.0, partner_timeout_s=1.0))

    assert ends(0.9) == []
    tracker.on_partner(Now(100.9, 0.0))  # long adaptations are no silence
    assert ends(1.8) == []
    assert ends(2.0) == ['Ended POLICY_LOST']


def test_request_with_an_endless_name_is_refused(tracker: GoalTracker) -> None:
    see(tracker, 1)
    assert kinds(tracker.request(to(request_id='x' * 257), START)) == ['Rejected WRONG_SIZE']


@pytest.mark.parametrize('silence', [(1.5, 0.0), (0.0, 1.5)], ids=['real', 'simulated'])
def test_realtime_goal_is_lost_by_either_clock(silence: tuple[float, float]) -> None:
    tracker = GoalTracker(CATALOG, START, realtime=True)
    see(tracker, 1)
    tracker.request(to(), START)
    assert not lost(tracker, 0.9, 0.9)
    assert lost(tracker, *silence) == 'no state of episode 1 for 1.5 s'


# --- random sequences ---------------------------------------------------------------------------

episodes = st.integers(0, 4)
worlds = st.sampled_from([0, 0xA, 0xB])
spots = st.sampled_from([FREE, ALSO_FREE, (0.0, 0.0), IN_WALL, (100.0, 0.0), (np.nan, 0.0)])


class Life(RuleBasedStateMachine):
    """Everything that a goal node can be told, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.now = START
        self.tracker = GoalTracker(CATALOG, START)
        self.accepted: list[int] = []
        self.ended: list[int] = []
        self.in_force: dict = {}

    def follow(self, changes, *possible: str) -> None:
        """Book the changes; an end has to be for one of the `possible` reasons."""
        for change in changes:
            match change:
                case Accepted(goal):
                    assert self.in_force == {}
                    assert goal.query_id == len(self.accepted) + 1
                    self.accepted.append(goal.query_id)
                    self.in_force[goal.query_id] = goal
                case Ended(goal, verdict, step, seconds):
                    assert self.in_force.pop(goal.query_id) is goal
                    self.ended.append(goal.query_id)
                    assert verdict.error in possible
                    assert step >= goal.first_step
                    assert seconds >= 0

    @rule(
        spot=spots,
        episode_id=episodes,
        world_id=worlds,
        frame=st.sampled_from(['map', 'map', 'odom']),
    )
    def request(self, spot, episode_id: int, world_id: int, frame: str) -> None:
        before = self.tracker.goal
        request = to(spot, episode_id=episode_id, frame_id=frame, world_id=world_id)
        changes = self.tracker.request(request, self.now)
        self.follow(changes, 'PREEMPTED')
        if isinstance(changes[-1], Rejected):
            assert len(changes) == 1
            assert self.tracker.goal is before
        else:
            assert episode_id in (0, self.tracker.goal.episode_id)
            assert world_id in (0, self.tracker.goal.world_id)

    @rule(
        episode_id=episodes.filter(bool),
        step=st.integers(0, 60),
        spot=spots.filter(lambda xy: np.isfinite(xy).all()),
        published_ns=st.integers(0, 9),
        ended=st.booleans(),
        success=st.booleans(),
        world_id=worlds,
    )
    def state(self, episode_id: int, step: int, spot, published_ns: int, **flags) -> None:
        before = self.tracker.goal
        changes = self.tracker.on_state(
            RobotState(episode_id, step, spot, **flags),
            published_ns,
            self.now,
            tolerance_m=1.0,
            max_steps=50,
        )
        self.follow(changes, 'NONE', 'TIMED_OUT', 'EPISODE_ENDED', 'NEW_EPISODE')
        if any(isinstance(change, Ignored) for change in changes):
            assert self.tracker.goal is before
            return
        own = before is not None and (
            before.episode_id == episode_id and before.world_id in (0, flags['world_id'])
        )
        for change in changes:
            assert own or change.verdict.error == 'NEW_EPISODE'
        if own and flags['ended']:
            assert self.tracker.goal is None

    @rule(
        episode_id=episodes.filter(bool),
        published_ns=st.integers(0, 9),
        spot=st.none() | spots,
        world_id=worlds,
    )
    def episode(self, episode_id: int, published_ns: int, spot, world_id: int) -> None:
        task = None
        if spot is not None:
            task = to(
                observation=np.array(spot),
                episode_id=episode_id,
                is_task=True,
                world_id=world_id,
            )
        start = Moment(world_id, episode_id)
        changes = self.tracker.on_episode(start, published_ns, self.now, task)
        self.follow(changes, 'NEW_EPISODE', 'PREEMPTED')
        for change in changes:
            if isinstance(change, Accepted):
                assert change.goal.episode_id == episode_id
                assert change.goal.world_id == world_id

    @rule(seconds=st.floats(0, 3), has_source=st.booleans())
    def time(self, seconds: float, has_source: bool) -> None:
        self.now = Now(self.now.steady_s + seconds, self.now.clock_s + 2 * seconds)
        changes = self.tracker.on_time(
            self.now, has_source=has_source, timeout_s=1.0, partner_timeout_s=5.0
        )
        self.follow(changes, 'STATE_LOST', 'POLICY_LOST')

    @rule()
    def cancel(self) -> None:
        self.follow(self.tracker.end(Verdict('CANCELED', 'canceled'), self.now), 'CANCELED')
        assert self.tracker.goal is None

    @invariant()
    def the_goal_in_force_is_the_one_that_was_announced(self) -> None:
        goal = self.tracker.goal
        assert list(self.in_force.values()) == ([] if goal is None else [goal])

    @invariant()
    def a_goal_is_in_force_in_its_own_episode_only(self) -> None:
        goal, state = self.tracker.goal, self.tracker.state
        if goal is not None and state is not None:
            assert state.episode_id == goal.episode_id
            assert goal.world_id in (0, state.world_id)

    def teardown(self) -> None:
        self.follow(self.tracker.end(Verdict('SHUTDOWN', ''), self.now), 'SHUTDOWN')
        assert self.accepted == sorted(self.ended) == list(range(1, len(self.accepted) + 1))


TestLife = Life.TestCase
TestLife.settings = settings(max_examples=100, stateful_step_count=40, deadline=None)


class RealtimeLife(Life):
    """The same in realtime, where the clocks count as well."""

    def __init__(self) -> None:
        super().__init__()
        self.tracker = GoalTracker(CATALOG, START, realtime=True)


TestRealtimeLife = RealtimeLife.TestCase
TestRealtimeLife.settings = TestLife.settings
