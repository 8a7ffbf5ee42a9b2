"""The life of goals: requests are accepted or rejected, and a goal in force ends."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from metagcttt.goal.goals import AcceptedGoal, Catalog, goal_ending, RobotState
from metagcttt.goal.verdict import Verdict
from metagcttt.worlds import Moment, RESTART_STATES, WorldOrder

MAX_REQUEST_ID = 256


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
        world_id: The only world in which it counts, awaited if need be; 0: the newest.
        quaternion: Orientation at the goal: x, y, z, w.
        names: Observed values of a robot that it fixes by name, which replace the position.
        values: One for each name.
        tolerances: One for each name, or none.
        timeout_s: Time that it may take, seconds; 0: the catalog's.
    """

    seed: int
    xy: tuple[float, float] = (0.0, 0.0)
    frame_id: str = ''
    observation: NDArray[np.float64] | None = None
    episode_id: int = 0
    is_task: bool = False
    max_steps: int = 0
    request_id: str = ''
    world_id: int = 0
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()
    tolerances: tuple[float, ...] = ()
    timeout_s: float = 0.0


@dataclass(frozen=True)
class Accepted:
    """A goal came into force."""

    goal: AcceptedGoal


@dataclass(frozen=True)
class Rejected:
    """A request was rejected at a moment; all 0 before the first state."""

    request: GoalRequest
    verdict: Verdict
    moment: Moment


@dataclass(frozen=True)
class Ended:
    """The goal in force ended at a control step of its episode, some time after acceptance."""

    goal: AcceptedGoal
    verdict: Verdict
    step: int
    seconds: float


@dataclass(frozen=True)
class Ignored:
    """A state or the start of an episode was ignored, as it is not of the present."""

    reason: str


Change = Accepted | Rejected | Ended | Ignored


class GoalTracker:
    """Decides which goal is in force, one at a time.

    A goal belongs to an episode of a world: a newer goal replaces it, and another episode or world
    voids it. A goal for an episode that is still to come waits for it, and leaves the present as
    it is. Every input returns the changes that it made, in their order.

    Attributes:
        goal: The goal in force; None when there is none.
    """

    def __init__(self, catalog: Catalog, now: Now, *, realtime: bool = False) -> None:
        """Start without an episode.

        Args:
            catalog: Checks and completes goals.
            now: The current time.
            realtime: Whether states that are late are faults, and may be out of order.
        """
        self.goal: AcceptedGoal | None = None
        self._catalog = catalog
        self._realtime = realtime
        # In lockstep, states are delivered in order, and one that begins again has no successor.
        self._order = WorldOrder(RESTART_STATES if realtime else 1)
        self._state: RobotState | None = None  # newest of the present episode
        self._is_awaited = False  # the episode of the goal in force
        self._goal_step = 0  # newest step of the goal in force
        self._num_worlds = 0
        self._seen = now
        self._source_seen_s = self._partner_seen_s = now.steady_s
        self._num_accepted = 0

    @property
    def state(self) -> RobotState | None:
        """The newest state of the goal's episode, or of the present one without a goal."""
        return None if self._is_awaited else self._state

    # --- requests ----------------------------------------------------------------------------

    def request(self, request: GoalRequest, now: Now) -> list[Change]:
        """Accept a request or reject it."""
        refusal = self.refusal(request)
        return self.accept(request, now) if refusal is None else [self.reject(request, refusal)]

    def refusal(self, request: GoalRequest) -> Verdict | None:
        """The reason why a request cannot be accepted; None when it can."""
        if len(request.request_id) > MAX_REQUEST_ID:
            reason = f'request_id is longer than {MAX_REQUEST_ID} characters'
            return Verdict('WRONG_SIZE', reason)
        if not (math.isfinite(request.timeout_s) and request.timeout_s >= 0):
            return Verdict('NOT_FINITE', f'a time limit of {request.timeout_s} s is none')
        if refusal := self._episode_refusal(request):
            return refusal
        resolved = self._catalog.resolve(request)
        return resolved if isinstance(resolved, Verdict) else None

    def _episode_refusal(self, request: GoalRequest) -> Verdict | None:
        present = self._order.now
        if present is None:
            if request.episode_id:
                return None
            return Verdict('NO_STATE', 'no state of the simulator has arrived yet')
        if request.world_id not in (0, present.world_id):
            if request.episode_id:
                return None
            reason = f'world {request.world_id:x} is not the present one, {present.world_id:x}'
            return Verdict('EPISODE_OVER', reason)
        newest = present.episode_id
        if request.episode_id and request.episode_id < newest:
            reason = f'episode {request.episode_id} is over, {newest} is the newest'
            return Verdict('EPISODE_OVER', reason)
        if request.episode_id <= newest and self._state is not None and self._state.ended:
            reason = f'episode {newest} has ended: reset the simulator or set a task'
            return Verdict('EPISODE_OVER', reason)
        return None

    def reject(self, request: GoalRequest, refusal: Verdict) -> Rejected:
        """The rejection of a request now."""
        return Rejected(request, refusal, self._order.now or Moment(0, 0))

    def accept(self, request: GoalRequest, now: Now) -> list[Change]:
        """Put in force a goal that `refusal` does not refuse; it replaces the one before."""
        self._num_accepted += 1
        number = self._num_accepted
        changes = self.end(Verdict('PREEMPTED', f'goal {number} took its place'), now)
        present = self._order.now or Moment(request.world_id, 0)
        world_id = request.world_id or present.world_id
        episode_id = request.episode_id or present.episode_id
        self._is_awaited = (world_id, episode_id) != present[:2]
        resolved = self._catalog.resolve(request)
        assert not isinstance(resolved, Verdict), 'the caller looked'
        self.goal = AcceptedGoal(
            query_id=number,
            episode_id=episode_id,
            observation=resolved.observation,
            xy=resolved.xy,
            terms=resolved.terms,
            timeout_s=request.timeout_s or resolved.timeout_s,
            seed=request.seed,
            world_id=world_id,
            first_step=0 if self.state is None or request.is_task else self.state.step,
            is_task=request.is_task,
            max_steps=request.max_steps,
            request_id=request.request_id,
            accepted_s=now.clock_s,
        )
        self._goal_step = self.goal.first_step
        self._partner_seen_s = now.steady_s
        return [*changes, Accepted(self.goal)]

    def end(self, verdict: Verdict, now: Now) -> list[Change]:
        """End the goal in force, if there is one."""
        goal, self.goal, self._is_awaited = self.goal, None, False
        if goal is None:
            return []
        return [Ended(goal, verdict, self._goal_step, now.clock_s - goal.accepted_s)]

    # --- the simulator -----------------------------------------------------------------------

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
        before = self._order.now
        if refusal := self._order.refuse_state(state.moment, published_ns):
            return [Ignored(refusal)]
        changes = self._turn_to_present(before, now)
        if self._order.now != before:
            self._partner_seen_s = now.steady_s
        self._state = state
        if self._is_awaited:
            return changes
        self._seen = now
        if self.goal is not None:
            self._goal_step = max(self._goal_step, state.step)
            ending = goal_ending(
                self.goal,
                state,
                tolerance_m=tolerance_m,
                max_steps=max_steps,
                seconds=now.clock_s - self.goal.accepted_s,
            )
            if ending is not None:
                changes += self.end(ending, now)
        return changes

    def on_episode(
        self, start: Moment, published_ns: int, now: Now, task: GoalRequest | None = None
    ) -> list[Change]:
        """Take in the start of an episode, which may come before or after its first state.

        Args:
            start: The start.
            published_ns: Time of its publication, nanoseconds.
            now: The current time.
            task: The episode's own goal, if it has one.
        """
        before = self._order.now
        if refusal := self._order.refuse_start(start, published_ns):
            return [Ignored(refusal)]
        changes = self._turn_to_present(before, now)
        return changes if task is None else changes + self.request(task, now)

    def on_partner(self, now: Now) -> None:
        """Take in a sign of life of the policy."""
        self._partner_seen_s = now.steady_s

    def on_time(
        self, now: Now, *, has_source: bool, timeout_s: float, partner_timeout_s: float
    ) -> list[Change]:
        """End the goal in force when the simulator is gone or, in realtime, silent.

        In lockstep the simulator waits for actions, however long they take, but not for a policy
        that is gone.

        Args:
            now: The current time.
            has_source: Whether anybody publishes states.
            timeout_s: Longest absence of the simulator, seconds.
            partner_timeout_s: Lockstep: longest time without a step or a status, seconds.
        """
        if has_source and (self.goal is None or self.state is not None):
            self._source_seen_s = now.steady_s
        if self.goal is None:
            return []
        age_s = now.steady_s - self._source_seen_s
        if self._realtime:
            seen = self._seen
            age_s = max(age_s, now.clock_s - seen.clock_s, now.steady_s - seen.steady_s)
        if age_s > timeout_s:
            reason = f'no state of episode {self.goal.episode_id} for {age_s:.1f} s'
            return self.end(Verdict('STATE_LOST', reason), now)
        silent_s = now.steady_s - self._partner_seen_s
        if not self._realtime and silent_s > partner_timeout_s:
            reason = f'no step and no status of the policy for {silent_s:.1f} s'
            return self.end(Verdict('POLICY_LOST', reason), now)
        return []

    def _turn_to_present(self, before: Moment | None, now: Now) -> list[Change]:
        """Forget the state of another episode than the present one, and end a goal of it."""
        present = self._order.now
        assert present is not None, 'the caller moved it'
        is_other_world = self._order.num_worlds != self._num_worlds
        self._num_worlds = self._order.num_worlds
        if not is_other_world and before is not None and before[:2] == present[:2]:
            return []
        self._state, self._seen = None, now
        if self.goal is None:
            return []
        in_its_world = self.goal.world_id in (0, present.world_id)
        is_ahead = self._is_awaited and self.goal.episode_id >= present.episode_id
        if in_its_world and is_ahead:
            self._is_awaited = self.goal.episode_id > present.episode_id
            return []
        if self._is_awaited and not in_its_world and (not is_other_world or before is None):
            return []
        what = 'the simulator was started again: ' if is_other_world else ''
        reason = f'{what}episode {present.episode_id} began'
        return self.end(Verdict('NEW_EPISODE', reason), now)
