"""One robot's recorded messages as trajectories, cut where they do not follow one another."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from metagcttt_core.data.errors import DatasetError
import numpy as np

SENDER_TIMEOUT_NS = 10**9  # as long as the simulator remembers one
LATE_PERIODS = 3.0

IDLE = 'idle steps'
BACK = 'steps back in time'
GAPS = 'gaps between states'
STAMPS = 'jumps of the stamps'
CLOCK_JUMPS = 'jumps of a clock'
WORLDS = 'changes to another world'
SENDERS = 'steps with several senders of actions'
CONTESTED = 'transitions to a state that was recorded twice'
OTHER_STATE = 'actions for another state than the last one'
MISFITS = (BACK, GAPS, STAMPS, CLOCK_JUMPS, WORLDS, SENDERS, CONTESTED)
"""Reasons that two states in sequence are not two states of one robot in sequence."""


def usual_period_s(states: Iterable[Any]) -> float:
    """The usual time between consecutive states by their stamps, seconds; 0: not stamped."""
    periods_s = [
        _stamp_s(after) - _stamp_s(before)
        for before, after in pairwise(states)
        if (after.episode_id, after.step) == (before.episode_id, before.step + 1)
        and hasattr(after, 'header')
    ]
    return max(float(np.median(periods_s)), 0.0) if periods_s else 0.0


def _stamp_s(state: Any) -> float:
    return state.header.stamp.sec + 1e-9 * state.header.stamp.nanosec


def _world(message: Any) -> int:
    """What tells a simulator from the next one with the same numbers; 0 in older recordings."""
    return int(getattr(message, 'world_id', 0))


def _moment(message: Any) -> tuple[int, int, int]:
    """The state that a message is, or is for."""
    return _world(message), message.episode_id, message.step


@dataclass
class Robot:
    """Turns one robot's messages, in the order of publication, into trajectories.

    Attributes:
        name: Its namespace.
        usual_period_s: Usual time from one state to the next by their stamps; 0: not stamped.
        dropped: How often something was left out, by reason; added to.
        trajectories: Observations and actions of each finished trajectory.
    """

    name: str
    usual_period_s: float
    keep_idle: bool
    refuse_gaps: bool
    dropped: Counter[str]
    trajectories: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    _state: Any = None
    _action: Any = None
    _senders_ns: dict[int, int] = field(default_factory=dict)
    _observations: list[np.ndarray] = field(default_factory=list)
    _actions: list[np.ndarray] = field(default_factory=list)

    def take_action(self, message: Any, published_ns: int) -> None:
        """Remember the newest action for the current state; the simulator does the same."""
        self._senders_ns[getattr(message, 'instance', 0)] = published_ns
        state = self._state
        if state is None or _moment(message) != _moment(state):
            self.dropped[OTHER_STATE] += 1
        elif not np.isfinite(message.values).all():
            self.dropped['actions that are not finite'] += 1
        else:
            self._action = message

    def take_state(self, message: Any, published_ns: int) -> None:
        """Add the transition to this state, or say why there is none."""
        last = self._state
        if not np.isfinite(message.observation).all():
            self.dropped['states that are not finite'] += 1
            return
        if last is not None:
            if _moment(message) == _moment(last) and (
                list(message.observation) == list(last.observation)
            ):
                self.dropped['repeated states'] += 1
                return
            reason = self._break(last, message, published_ns)
            if reason:
                self._cut(reason)
            elif message.episode_id != last.episode_id:
                self.finish()
            else:
                self._actions.append(np.array(self._action.values))
        self._state, self._action = message, None
        self._observations.append(np.array(message.observation))

    def clock_jumped(self) -> None:
        """Cut where a clock was changed."""
        if self._state is not None:
            self._cut(CLOCK_JUMPS)
        self.finish()

    def finish(self) -> None:
        """Close the trajectory under way with its last state, which has no action."""
        if self._actions:
            self._actions.append(np.zeros_like(self._actions[0]))
            self.trajectories.append((self._stack(self._observations), self._stack(self._actions)))
        self._observations, self._actions = [], []
        self._state, self._action = None, None

    def _break(self, last: Any, state: Any, published_ns: int) -> str:
        """The reason why two states of an episode form no transition; empty if they do."""
        if state.episode_id != last.episode_id:
            return ''
        if _world(state) != _world(last):
            return WORLDS
        if state.step <= last.step:
            if state.step:  # not a simulator that began again
                self._contest(last.step - state.step)
            return BACK
        if state.step != last.step + 1:
            return GAPS
        if self.usual_period_s:
            period_s = _stamp_s(state) - _stamp_s(last)
            if not 0 < period_s <= LATE_PERIODS * self.usual_period_s:
                return STAMPS
        if self._num_senders(published_ns) > 1:
            return SENDERS
        if self._action is None:
            return 'states without an action'
        if not self.keep_idle and not self._action.query_id:
            return IDLE
        return ''

    def _contest(self, num_steps: int) -> None:
        """Give up the transitions to the last steps, which were recorded a second time.

        Whose state each of them is cannot be told, so any may join two robots.
        """
        kept = max(0, len(self._actions) - num_steps - 1)
        self.dropped[CONTESTED] += len(self._actions) - kept
        del self._actions[kept:], self._observations[kept + 1 :]

    def _num_senders(self, now_ns: int) -> int:
        """Senders of actions within the last second; with several, the simulator applied zero."""
        return sum(now_ns - sent_ns <= SENDER_TIMEOUT_NS for sent_ns in self._senders_ns.values())

    def _cut(self, reason: str) -> None:
        if self.refuse_gaps and reason != IDLE:
            raise DatasetError(
                f'{self.name}: {reason} after step {self._state.step} of episode '
                f'{self._state.episode_id}'
            )
        self.dropped[reason] += 1
        self.finish()

    def _stack(self, rows: list[np.ndarray]) -> np.ndarray:
        sizes = sorted({len(row) for row in rows})
        if len(sizes) > 1:
            raise DatasetError(
                f'{self.name}: vectors of {sizes[0]} and {sizes[1]} values in episode '
                f'{self._state.episode_id}; they must be equally long'
            )
        return np.stack(rows)
