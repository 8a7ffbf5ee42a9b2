"""Accepted goals, the check of a goal against the maze, and the end of a goal."""

from dataclasses import dataclass
import math
from typing import Literal

from metagcttt_core import TrajectoryFilter
import numpy as np
from numpy.typing import NDArray
from sim_bridge import MazeDescription

from metagcttt.goal_in_force import Goal
from metagcttt.input_checks import vector_fault
from metagcttt.worlds import Moment

Error = Literal[
    'NONE',
    'WRONG_FRAME',
    'NOT_FINITE',
    'OUTSIDE_MAZE',
    'IN_WALL',
    'WRONG_SIZE',
    'NO_STATE',
    'EPISODE_OVER',
    'PREEMPTED',
    'CANCELED',
    'TIMED_OUT',
    'EPISODE_ENDED',
    'NEW_EPISODE',
    'STATE_LOST',
    'SHUTDOWN',
    'POLICY_LOST',
]
"""The names of the error codes of ReachGoal's result."""


@dataclass(frozen=True)
class Verdict:
    """The reason why a goal is refused, or how it ended: a code and the words."""

    error: Error
    reason: str


@dataclass(frozen=True)
class AcceptedGoal(Goal):
    """A goal with what decides about its end and what its sender is told.

    Attributes:
        first_step: Control step of the episode from which its steps count.
        is_task: Whether it is the goal of the episode's own task.
        max_steps: Control steps that it may take; 0 for the goal node's own limit.
        request_id: Name that the sender of an action goal gave it.
        accepted_s: Time of acceptance, seconds of the goal node's clock.
    """

    first_step: int = 0
    is_task: bool = False
    max_steps: int = 0
    request_id: str = ''
    accepted_s: float = 0.0


@dataclass(frozen=True)
class RobotState:
    """A state of the robot in an episode, as far as it decides about goals.

    Attributes:
        episode_id: Its episode.
        step: Its control step.
        xy: The robot's position in metres.
        ended: Whether the episode ended with this state.
        success: Whether the robot is at the goal of the episode's task, as the simulator judges.
        world_id: Its world; 0 when it names none.
    """

    episode_id: int
    step: int
    xy: tuple[float, float]
    ended: bool = False
    success: bool = False
    world_id: int = 0

    @property
    def moment(self) -> Moment:
        """Its place in time."""
        return Moment(self.world_id, self.episode_id, self.step)


class GoalCatalog:
    """Checks positions against a maze and completes them to goal observations."""

    def __init__(self, description: MazeDescription, trajectory_filter: TrajectoryFilter) -> None:
        """Create the catalog of a maze and a dataset recorded in it.

        Raises:
            ValueError: If the dataset has other observations than the maze.
        """
        data = trajectory_filter.dataset
        if data.obs_dim != description.spec.obs_dim:
            raise ValueError(
                f'the dataset {data.source or ""} has observations of {data.obs_dim} values, '
                f'{description.spec.name} of {description.spec.obs_dim}'
            )
        self._maze = description.maze
        self._position_dims = list(description.spec.position_dims)
        self._filter = trajectory_filter

    def refusal(self, x: float, y: float) -> Verdict | None:
        """The reason why the position (x, y), in metres, cannot be a goal; None when it can."""
        if not (math.isfinite(x) and math.isfinite(y)):
            return Verdict('NOT_FINITE', f'the position ({x}, {y}) is not finite')
        if not self._maze.contains(x, y):
            xmin, xmax, ymin, ymax = self._maze.extent
            return Verdict(
                'OUTSIDE_MAZE',
                f'({x:.2f}, {y:.2f}) is outside the maze, which spans x {xmin:g} to {xmax:g} '
                f'and y {ymin:g} to {ymax:g} metres',
            )
        if not self._maze.is_free(x, y):
            reason = f'({x:.2f}, {y:.2f}) is in a wall, cell {self._maze.cell(x, y)}'
            return Verdict('IN_WALL', reason)
        return None

    def observation_refusal(self, observation: NDArray[np.float64]) -> Verdict | None:
        """The reason why a goal observation, shape (n,), cannot be a goal; None when it can."""
        fault = vector_fault('the goal', observation, self._filter.dataset.obs_dim)
        if fault:
            wrong_size = observation.shape != (self._filter.dataset.obs_dim,)
            return Verdict('WRONG_SIZE' if wrong_size else 'NOT_FINITE', fault)
        return self.refusal(*self.position(observation))

    def complete(self, x: float, y: float) -> NDArray[np.float64]:
        """A goal observation at the position (x, y), in metres, shape (obs_dim,), float64.

        The other values are those of the dataset's state nearest to the position.
        """
        row = self._filter.nearest_row(np.array((x, y)))
        observation = np.array(self._filter.dataset.observations[row], dtype=np.float64)
        observation[self._position_dims] = (x, y)
        return observation

    def position(self, observation: NDArray[np.float64]) -> tuple[float, float]:
        """The position (x, y), in metres, in an observation of shape (obs_dim,)."""
        x, y = observation[self._position_dims]
        return float(x), float(y)


def goal_ending(
    goal: AcceptedGoal, state: RobotState, *, tolerance_m: float, max_steps: int
) -> Verdict | None:
    """The ending of a goal in a state of its episode; None while it is under way.

    Args:
        goal: The goal.
        state: The state.
        tolerance_m: Distance within which a goal is reached, metres.
        max_steps: Control steps that a goal may take unless it says otherwise.

    Returns:
        The verdict, with error `NONE` when the goal was reached.
    """
    steps = state.step - goal.first_step
    distance_m = math.dist(state.xy, goal.xy)
    if distance_m <= tolerance_m or (goal.is_task and state.success):
        return Verdict('NONE', f'after {steps} steps, {distance_m:.2f} m from the goal')
    if steps >= (goal.max_steps or max_steps):
        reason = f'not reached in {steps} steps, {distance_m:.2f} m from the goal'
        return Verdict('TIMED_OUT', reason)
    if state.ended:
        return Verdict('EPISODE_ENDED', f'the episode ended {distance_m:.2f} m from the goal')
    return None
