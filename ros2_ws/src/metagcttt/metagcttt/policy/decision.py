"""The decision about the next action, from the newest state and the goal in force."""

from dataclasses import dataclass, field
from typing import Literal

from metagcttt_core import Adaptation, TTTConfig
import numpy as np
from numpy.typing import NDArray

from metagcttt.goal_in_force import Goal


@dataclass(frozen=True)
class State:
    """A state as received.

    Attributes:
        episode_id: Its episode.
        step: Its control step.
        observation: Shape (obs_dim,), float64, unless there is a fault.
        ended: The episode is over, so no action follows.
        fault: Why no action can be computed from it; empty when one can.
        world_id: Its world; 0 when it names none.
    """

    episode_id: int
    step: int
    observation: NDArray[np.float64]
    ended: bool
    fault: str = ''
    world_id: int = 0


@dataclass
class Progress:
    """The gradient steps done in one adaptation, counted by the thread that takes them."""

    steps_done: int = 0

    def __call__(self, step: int, losses: object = None) -> None:
        """Record that `step` steps are done."""
        self.steps_done = step


@dataclass
class Pursuit:
    """The policy's work on the goal in force.

    Attributes:
        goal: The goal.
        config: Inner loop for this goal.
        hold: Whether to wait for the expert instead of acting with the current weights.
        adaptation: The newest one; its agent acts. At first the base policy, with the reason.
        adapting: Whether an adaptation is under way.
        adapted_at: Control step of the state that was last adapted to.
        progress: Of the newest adaptation.
        fallback: Why it is not the adapter's, where there is one to ask; else empty.
    """

    goal: Goal
    config: TTTConfig
    hold: bool
    adaptation: Adaptation
    adapting: bool = False
    adapted_at: int | None = None
    progress: Progress = field(default_factory=Progress)
    fallback: str = ''

    def serves(self, state: State) -> bool:
        """True when the goal counts in `state`."""
        return self.is_for(state) and not state.ended

    def is_for(self, state: State) -> bool:
        """True when `state` is of the goal's episode and world."""
        same_world = self.goal.world_id in (0, state.world_id)
        return same_world and state.episode_id == self.goal.episode_id

    def needs_adaptation(self, state: State) -> bool:
        """True when an adaptation is due: the first, or `horizon` steps after the last."""
        if self.adapting or state.fault or not self.serves(state):
            return False
        if self.adapted_at is None:
            return True
        return bool(self.config.horizon and state.step - self.adapted_at >= self.config.horizon)

    def idle_reason(self, state: State) -> str:
        """The reason why `state` gets no action towards the goal; empty when it gets one."""
        if not self.is_for(state) and state.episode_id == self.goal.episode_id:
            return f'the goal is for world {self.goal.world_id:x}, not {state.world_id:x}'
        if state.episode_id != self.goal.episode_id:
            return f'the goal is for episode {self.goal.episode_id}, not {state.episode_id}'
        if state.ended:
            return f'episode {state.episode_id} has ended'
        return 'waiting for the expert' if self.hold and self.adapting else ''


@dataclass(frozen=True)
class Command:
    """An action, the goal it serves and, when it is zero by decision, why.

    Attributes:
        values: The action, shape (act_dim,); finite.
        query_id: Number of the goal; 0 when there is none to act on.
        adapted: Whether an adapted expert computed it.
        cause: What made it zero: nothing to do, a safety reason or an unusable output of the
            policy; empty for the policy's own action.
        reason: The same in words.
    """

    values: NDArray[np.floating]
    query_id: int = 0
    adapted: bool = False
    cause: Literal['', 'idle', 'unsafe', 'unusable'] = ''
    reason: str = ''


def decide(state: State, pursuit: Pursuit | None, unsafe: str, act_dim: int) -> Command:
    """The command for a state: the expert's action, or zero with the reason.

    Args:
        state: The newest state.
        pursuit: The policy's work on the goal in force, if there is one.
        unsafe: Why the robot must stand still, from `Safety`; empty when it may move.
        act_dim: Length of an action.
    """
    still = np.zeros(act_dim)
    idle = 'no goal' if pursuit is None else pursuit.idle_reason(state)
    query_id = 0 if pursuit is None or idle else pursuit.goal.query_id
    if unsafe or state.fault:
        return Command(still, query_id, cause='unsafe', reason=unsafe or state.fault)
    if pursuit is None or idle:
        return Command(still, cause='idle', reason=idle)
    values = pursuit.adaptation.agent.act(state.observation, pursuit.goal.observation)
    if not np.isfinite(values).all():
        reason = f'the policy returned {values.tolist()}'
        return Command(still, query_id, cause='unusable', reason=reason)
    return Command(values, query_id, pursuit.adaptation.accepted)
