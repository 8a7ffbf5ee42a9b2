"""What makes a goal acceptable, and when it is over. No ROS in here."""

from dataclasses import dataclass
import math
from typing import Literal

from metagcttt_core import TrajectoryFilter
import numpy as np
from numpy.typing import NDArray
from sim_bridge import MazeDescription


@dataclass(frozen=True)
class Goal:
    """An accepted goal.

    Attributes:
        query_id: Its number.
        episode_id: The episode in which it counts.
        observation: Full goal observation, shape (obs_dim,), float64.
        xy: Its position in metres.
        seed: Seed of the adaptation to it.
        first_step: Control step of the episode at which it was accepted.
        is_task: Whether it is the goal of the episode's own task.
    """

    query_id: int
    episode_id: int
    observation: NDArray[np.float64]
    xy: tuple[float, float]
    seed: int
    first_step: int
    is_task: bool


class GoalCatalog:
    """Checks positions against a maze and completes them to goal observations."""

    def __init__(self, description: MazeDescription, trajectory_filter: TrajectoryFilter) -> None:
        """Use a maze and a dataset that was recorded in it.

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

    def refusal(self, x: float, y: float) -> str:
        """Why the position (x, y), in metres, cannot be a goal; empty when it can."""
        if not (math.isfinite(x) and math.isfinite(y)):
            return f'the position ({x}, {y}) is not finite'
        if not self._maze.contains(x, y):
            xmin, xmax, ymin, ymax = self._maze.extent
            return (
                f'({x:.2f}, {y:.2f}) is outside the maze, which spans x {xmin:g} to {xmax:g} '
                f'and y {ymin:g} to {ymax:g} metres'
            )
        if not self._maze.is_free(x, y):
            return f'({x:.2f}, {y:.2f}) is in a wall, cell {self._maze.cell(x, y)}'
        return ''

    def complete(self, x: float, y: float) -> NDArray[np.float64]:
        """A goal observation at the position (x, y), in metres, shape (obs_dim,), float64.

        Everything but the position is taken from the dataset's state nearest to it.
        """
        row = self._filter.nearest_row(np.array((x, y)))
        observation = np.array(self._filter.dataset.observations[row], dtype=np.float64)
        observation[self._position_dims] = (x, y)
        return observation

    def position(self, observation: NDArray[np.float64]) -> tuple[float, float]:
        """Where x and y, in metres, stand in an observation of shape (obs_dim,)."""
        x, y = observation[self._position_dims]
        return float(x), float(y)


Ending = Literal['reached', 'timed out']


def goal_ending(
    goal: Goal,
    *,
    xy: tuple[float, float],
    step: int,
    ended: bool,
    success: bool,
    tolerance_m: float,
    max_steps: int,
) -> tuple[Ending, str] | None:
    """Whether a goal is over in a state of its episode.

    Args:
        goal: The goal.
        xy: The agent's position in metres.
        step: Control step of the state.
        ended: The episode ended with this state.
        success: The agent is at the goal of the episode's task, by the simulator's own measure.
        tolerance_m: Distance within which a goal is reached, metres.
        max_steps: Control steps that a goal may take.

    Returns:
        How it ended and that in words, or None while it is under way.
    """
    steps = step - goal.first_step
    distance_m = math.dist(xy, goal.xy)
    if distance_m <= tolerance_m or (goal.is_task and success):
        return 'reached', f'after {steps} steps, {distance_m:.2f} m from the goal'
    if steps >= max_steps:
        return 'timed out', f'not reached in {steps} steps, {distance_m:.2f} m from the goal'
    if ended:
        return 'timed out', f'the episode ended {distance_m:.2f} m from the goal'
    return None
