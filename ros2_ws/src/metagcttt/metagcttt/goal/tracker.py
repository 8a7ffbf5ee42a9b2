"""The life of goals: requests are accepted or rejected, and a goal in force ends."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from metagcttt.goal.goals import AcceptedGoal, goal_ending, GoalCatalog, RobotState, Verdict
from metagcttt.input_checks import StateOrder


class Now(NamedTuple):
    """The current time in seconds, of a monotonic clock and of the node's (maybe simulated)."""

    steady_s: float
    clock_s: float


@dataclass(frozen=True)
class GoalRequest:
    """A request to put a goal in force.

    Attributes:
        seed: Random seed of the adaptation to it.
        xy: Position in metres.
        frame_id: Frame of the position.
        observation: Full goal observation, shape (n,), which replaces the position.
        episode_id: The only episode in which it counts, awaited if need be; 0: the newest.
        is_task: Whether it is the goal of the episode's own task, whose steps all count.
        max_steps: Control steps that it may take; 0: the goal node's own limit.
        request_id: Name that the sender gave it.
    """

    seed: int
    xy: tuple[float, float] = (0.0, 0.0)
    frame_id: str = ''
    observation: NDArray[np.float64] | None = None
    episode_id: int = 0
    is_task: bool = False
    max_steps: int = 0
    request_id: str = ''


@dataclass(frozen=True)
class Accepted:
    """A goal came into force."""

    goal: AcceptedGoal


@dataclass(frozen=True)
class Rejected:
    """A request was rejected at a control step of an episode; both 0 before the first state."""

    request: GoalRequest
    verdict: Verdict
    episode_id: int
    step: int


@dataclass(frozen=True)
class Ended:
    """The goal in force ended at a control step of its episode, some time after acceptance."""

    goal: AcceptedGoal
    verdict: Verdict
    step: int
    seconds: float


Change = Accepted | Rejected | Ended


class GoalTracker:
    """Decides which goal is in force, one at a time.

    A goal belongs to the episode in which it was accepted: a newer goal replaces it, and a new
    episode voids it. Every input returns the changes that it made, in their order.

    Attributes:
        goal: The goal in force; None when there is none.
        state: The newest state of the newest episode; None while the first one is awaited.
    """

    def __init__(
        self, catalog: GoalCatalog, frame_id: str, now: Now, *, realtime: bool = False
    ) -> None:
        """Start without an episode.

        Args:
            catalog: Checks and completes goals.
            frame_id: Frame of all positions.
            now: The current time.
            realtime: Whether states that are out of order or late are faults.
        """
        self.goal: AcceptedGoal | None = None
        self.state: RobotState | None = None
        self._catalog = catalog
        self._frame_id = frame_id
        self._realtime = realtime
        self._order = StateOrder()
        self._episode_id: int | None = None
        self._published_ns = 0
        self._awaiting_since = now
        self._source_seen_s = now.steady_s
        self._num_accepted = 0

    # --- requests ----------------------------------------------------------------------------

    def request(self, request: GoalRequest, now: Now) -> list[Change]:
        """Accept a request or reject it."""
        refusal = self.refusal(request)
        return self.accept(request, now) if refusal is None else [self.reject(request, refusal)]

    def refusal(self, request: GoalRequest) -> Verdict | None:
        """The reason why a request cannot be accepted; None when it can."""
        if request.observation is None and request.frame_id != self._frame_id:
            reason = f'the goal is in frame {request.frame_id!r}, goals are in {self._frame_id!r}'
            return Verdict('WRONG_FRAME', reason)
        newest = self._episode_id
        if newest is None:
            if not request.episode_id:
                return Verdict('NO_STATE', 'no state of the simulator has arrived yet')
        elif request.episode_id and request.episode_id < newest:
            reason = f'episode {request.episode_id} is over, {newest} is the newest'
            return Verdict('EPISODE_OVER', reason)
        elif request.episode_id <= newest and self.state is not None and self.state.ended:
            reason = f'episode {newest} has ended: reset the simulator or set a task'
            return Verdict('EPISODE_OVER', reason)
        if request.observation is not None:
            return self._catalog.observation_refusal(request.observation)
        return self._catalog.refusal(*request.xy)

    def reject(self, request: GoalRequest, refusal: Verdict) -> Rejected:
        """The rejection of a request now."""
        step = self.state.step if self.state is not None else 0
        return Rejected(request, refusal, self._episode_id or 0, step)

    def accept(self, request: GoalRequest, now: Now) -> list[Change]:
        """Put in force a goal that `refusal` does not refuse; it replaces the one before."""
        changes: list[Change] = []
        if request.episode_id > (self._episode_id or 0):
            changes += self._turn_to(request.episode_id, now)
        assert self._episode_id is not None, 'refused otherwise'
        self._num_accepted += 1
        number = self._num_accepted
        changes += self.end(Verdict('PREEMPTED', f'goal {number} took its place'), now)
        observation = request.observation
        if observation is None:
            observation = self._catalog.complete(*request.xy)
        self.goal = AcceptedGoal(
            query_id=number,
            episode_id=self._episode_id,
            observation=observation,
            xy=self._catalog.position(observation),
            seed=request.seed,
            first_step=0 if self.state is None or request.is_task else self.state.step,
            is_task=request.is_task,
            max_steps=request.max_steps,
            request_id=request.request_id,
            accepted_s=now.clock_s,
        )
        return [*changes, Accepted(self.goal)]

    def end(self, verdict: Verdict, now: Now) -> list[Change]:
        """End the goal in force, if there is one."""
        goal, self.goal = self.goal, None
        if goal is None:
            return []
        step = goal.first_step if self.state is None else max(goal.first_step, self.state.step)
        return [Ended(goal, verdict, step, now.clock_s - goal.accepted_s)]

    # --- the simulator -----------------------------------------------------------------------

    def order_fault(self, episode_id: int, step: int) -> str:
        """The reason why a state is out of order in realtime; empty when it can be used."""
        return self._order.refusal(episode_id, step) if self._realtime else ''

    def on_state(
        self, state: RobotState, published_ns: int, now: Now, *, tolerance_m: float, max_steps: int
    ) -> list[Change]:
        """Take in a state of the simulator.

        Args:
            state: The state.
            published_ns: Time of its publication, nanoseconds.
            now: The current time.
            tolerance_m: See `goal_ending`.
            max_steps: See `goal_ending`.
        """
        if self.goal is not None and state.episode_id < self.goal.episode_id:
            return []  # the first state of the goal's own episode is still to come
        changes = self._void_unless(state.episode_id, now)
        self.state, self._episode_id = state, state.episode_id
        self._published_ns, self._awaiting_since = published_ns, now
        if self.goal is not None:
            ending = goal_ending(self.goal, state, tolerance_m=tolerance_m, max_steps=max_steps)
            if ending is not None:
                changes += self.end(ending, now)
        return changes

    def on_episode(
        self, episode_id: int, published_ns: int, now: Now, task: GoalRequest | None = None
    ) -> list[Change]:
        """Take in the start of an episode, which may come before or after its first state.

        Args:
            episode_id: The episode.
            published_ns: Time of its publication, nanoseconds.
            now: The current time.
            task: The episode's own goal, if it has one.
        """
        if self._episode_id is not None and episode_id < self._episode_id:
            # Either a restarted simulator, or a latched event from before the newest state.
            if published_ns < self._published_ns:
                return []
        self._order = StateOrder()
        changes = self._turn_to(episode_id, now)
        return changes if task is None else changes + self.request(task, now)

    def on_time(self, now: Now, *, has_source: bool, timeout_s: float) -> list[Change]:
        """End the goal in force when the simulator is gone or, in realtime, silent.

        In lockstep the simulator waits for actions, however long they take.

        Args:
            now: The current time.
            has_source: Whether anybody publishes states.
            timeout_s: Longest absence of the simulator, seconds.
        """
        if has_source and (self.goal is None or self.state is not None):
            self._source_seen_s = now.steady_s
        age_s = now.steady_s - self._source_seen_s
        if self._realtime:
            since = self._awaiting_since
            age_s = max(age_s, now.clock_s - since.clock_s, now.steady_s - since.steady_s)
        if self.goal is None or age_s <= timeout_s:
            return []
        reason = f'no state of episode {self.goal.episode_id} for {age_s:.1f} s'
        return self.end(Verdict('STATE_LOST', reason), now)

    def _turn_to(self, episode_id: int, now: Now) -> list[Change]:
        """Begin to await the first state of another episode."""
        changes = self._void_unless(episode_id, now)
        if episode_id != self._episode_id:
            self._episode_id, self.state, self._awaiting_since = episode_id, None, now
        return changes

    def _void_unless(self, episode_id: int, now: Now) -> list[Change]:
        """End a goal of another episode."""
        if self.goal is None or self.goal.episode_id == episode_id:
            return []
        return self.end(Verdict('NEW_EPISODE', f'episode {episode_id} began'), now)
