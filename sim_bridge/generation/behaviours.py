"""Behaviour policies of offline data: OGBench's navigate, stitch and explore."""

from abc import ABC, abstractmethod
from typing import Literal

import numpy as np

from sim_bridge.maze_map import Cell, MazeMap
from sim_bridge.simulator import Array, Simulator

Kind = Literal['navigate', 'stitch', 'explore']

STITCH_CELLS = 4
NOISE = 0.25
"""Starts and goals are uniform within this fraction of a cell around its centre, per axis."""
EXPLORE_STEPS = 10


class Behaviour(ABC):
    """Chooses the start, the goals and the direction to walk in, for one episode.

    Source: OGBench, `data_gen_scripts/generate_locomaze.py`.

    Attributes:
        start_xy: Start of the episode, (x, y) in metres.
        goals_reached: Number of goals reached so far.
    """

    def __init__(self, maze: MazeMap, rng: np.random.Generator, to_goal: bool = False) -> None:
        """Draw the start: a free cell, and a point near its centre.

        Args:
            maze: The maze to walk in.
            rng: Source of randomness.
            to_goal: In the goal's cell, walk to the goal itself. OGBench walks to the cell's
                centre, where a robot that follows well lingers beside the goal.
        """
        self.maze = maze
        self.rng = rng
        self.to_goal = to_goal
        self.start_cell = self.draw(maze.free_cells())
        self.start_xy = self.near_center(self.start_cell)
        self.goals_reached = 0

    @abstractmethod
    def begin(self, simulator: Simulator) -> None:
        """Set the first goal, if any, in the episode that was just reset."""

    @abstractmethod
    def direction(self, simulator: Simulator, row: int) -> Array:
        """Unit vector (x, y) to walk along at this row of the episode."""

    @abstractmethod
    def at_goal(self, simulator: Simulator) -> None:
        """Handle arrival within the tolerance of the current goal."""

    def draw(self, cells: list[Cell]) -> Cell:
        """Draw one of the cells uniformly."""
        return cells[self.rng.integers(len(cells))]

    def near_center(self, cell: Cell) -> tuple[float, float]:
        """Draw a point near the centre of a cell."""
        x, y = self.maze.center(*cell)
        reach_m = NOISE * self.maze.unit_m
        dx, dy = self.rng.uniform(-reach_m, reach_m, size=2)
        return x + dx, y + dy


class _GoalSeeker(Behaviour):
    """Walks from cell to cell along the shortest path to a goal."""

    def __init__(self, maze: MazeMap, rng: np.random.Generator, to_goal: bool = False) -> None:
        """Draw start and goal."""
        super().__init__(maze, rng, to_goal)
        self._goal_cell = self._draw_goal()

    def begin(self, simulator: Simulator) -> None:
        """Set the goal near the centre of its cell."""
        self._goal_xy = self.near_center(self._goal_cell)
        simulator.set_goal(self._goal_xy)

    def direction(self, simulator: Simulator, row: int) -> Array:
        """Unit vector to the centre of the next cell on the path, at last to the goal's."""
        position = simulator.position
        goal = self._goal_xy if self.to_goal else self.maze.center(*self._goal_cell)
        target = self.maze.waypoint(self.maze.cell(*position), goal)
        return _unit(np.subtract(target, position))

    @abstractmethod
    def _draw_goal(self) -> Cell:
        """Draw the cell of the next goal."""


class Navigate(_GoalSeeker):
    """One goal after another, drawn from the free cells that are not corridors."""

    def at_goal(self, simulator: Simulator) -> None:
        """Count the goal and set the next one."""
        self.goals_reached += 1
        self._goal_cell = self._draw_goal()
        self.begin(simulator)

    def _draw_goal(self) -> Cell:
        return self.draw(self.maze.open_cells())


class Stitch(_GoalSeeker):
    """One goal exactly four cells away (the start's cell if there is none), then stays there."""

    def at_goal(self, simulator: Simulator) -> None:
        """Count the goal once."""
        self.goals_reached = 1

    def _draw_goal(self) -> Cell:
        return self.draw(
            self.maze.cells_at_distance(self.start_cell, STITCH_CELLS) or [self.start_cell]
        )


class Explore(Behaviour):
    """A new random direction every ten steps, and no goal."""

    def begin(self, simulator: Simulator) -> None:
        """Leave the episode without a goal."""

    def direction(self, simulator: Simulator, row: int) -> Array:
        """Unit vector of the current stretch of ten steps."""
        if row % EXPLORE_STEPS == 0:
            self._direction = _unit(self.rng.standard_normal(2))
        return self._direction

    def at_goal(self, simulator: Simulator) -> None:
        """Do nothing: there is no goal."""


BEHAVIOURS: dict[Kind, type[Behaviour]] = {
    'navigate': Navigate,
    'stitch': Stitch,
    'explore': Explore,
}


def _unit(vector: Array) -> Array:
    # OGBench's guard against division by zero; shortens the vector by a millionth.
    return vector / (np.linalg.norm(vector) + 1e-6)
