"""What the policy does with the newest state and the newest goal. No ROS in here."""

from collections.abc import Hashable
from dataclasses import dataclass

from metagcttt_core import Agent, TTTConfig
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class State:
    """A state as received.

    Attributes:
        episode_id: Its episode.
        step: Its control step.
        observation: Shape (obs_dim,), float64, unless there is a fault.
        ended: No action follows: the episode is over.
        fault: Why no action can be computed from it; empty when one can.
    """

    episode_id: int
    step: int
    observation: NDArray[np.float64]
    ended: bool
    fault: str = ''


@dataclass
class Query:
    """A goal to act on, and how far its adaptation is.

    Attributes:
        query_id: Its number.
        episode_id: The only episode in which it counts.
        goal: Goal observation, shape (obs_dim,), float64.
        seed: Seed of the adaptation.
        config: Inner loop for this query.
        hold: Whether to wait for the expert.
        expert: Whose actions to take: the base policy until an expert is ready.
        adapted: Whether `expert` is an adapted one.
        adapting: Whether an adaptation is under way.
        adapted_at: Control step of the state that was last adapted to.
        cache_key: Of the expert in the cache of experts.
        steps_done: Gradient steps done on it; counted by the thread that takes them.
    """

    query_id: int
    episode_id: int
    goal: NDArray[np.float64]
    seed: int
    config: TTTConfig
    hold: bool
    expert: Agent
    adapted: bool = False
    adapting: bool = False
    adapted_at: int | None = None
    steps_done: int = 0
    cache_key: Hashable = None

    def serves(self, state: State) -> bool:
        """Whether the goal counts in `state`."""
        return state.episode_id == self.episode_id and not state.ended

    def needs_adaptation(self, state: State) -> bool:
        """Whether to adapt to `state`: the first one, or `horizon` steps after the last time."""
        if self.adapting or state.fault or not self.serves(state):
            return False
        if self.adapted_at is None:
            return True
        return bool(self.config.horizon and state.step - self.adapted_at >= self.config.horizon)

    def has_action(self, state: State) -> bool:
        """Whether there is something to answer to `state`, be it zero for a faulty one."""
        return self.serves(state) and not (self.hold and self.adapting)


@dataclass(frozen=True)
class Command:
    """An action and where it comes from; `query_id` 0 and zeros when there is nothing to do.

    `fault` says why it is zero although a policy acted.
    """

    values: NDArray[np.floating]
    query_id: int = 0
    adapted: bool = False
    fault: str = ''


def choose(state: State, query: Query | None, act_dim: int) -> Command:
    """The action for a state: the expert's, or zero without a goal, a usable state or an expert.

    Args:
        state: The newest state.
        query: The goal in force, if any.
        act_dim: Length of an action.
    """
    if query is None or not query.has_action(state):
        return Command(np.zeros(act_dim))
    if state.fault:
        return Command(np.zeros(act_dim), query.query_id)
    values = query.expert.act(state.observation, query.goal)
    if not np.isfinite(values).all():
        fault = f'the policy gave {values.tolist()}'
        return Command(np.zeros(act_dim), query.query_id, fault=fault)
    return Command(values, query.query_id, query.adapted)
