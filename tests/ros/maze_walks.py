"""A dataset in which every evaluation task of a maze has a way to its goal."""

from metagcttt_core import TrajectoryDataset
import numpy as np
from sim_bridge import describe_environment, MazeMap

STEP_M = 0.2


def maze_walks(environment: str, repeats: int = 3) -> TrajectoryDataset:
    """Noisy walks through the cells between start and goal of each task; actions point ahead."""
    description = describe_environment(environment)
    rng = np.random.default_rng(0)
    walks = [
        _walk(description.maze, task.start_xy, task.goal_xy, rng)
        for task in description.tasks
        for _ in range(repeats)
    ]
    terminals = [np.arange(len(walk)) == len(walk) - 1 for walk in walks]
    actions = [np.diff(walk, axis=0, append=walk[-1:]) / STEP_M for walk in walks]
    return TrajectoryDataset.from_arrays(
        np.concatenate(walks), np.concatenate(actions).clip(-1, 1), np.concatenate(terminals)
    )


def _walk(
    maze: MazeMap,
    start_xy: tuple[float, float],
    goal_xy: tuple[float, float],
    rng: np.random.Generator,
) -> np.ndarray:
    cell, goal = maze.cell(*start_xy), maze.cell(*goal_xy)
    corners = [start_xy]
    while cell != goal:
        cell = maze.next_cell(cell, goal)
        corners.append(maze.center(*cell))
    per_cell = round(maze.unit_m / STEP_M)
    way = np.arange((len(corners) - 1) * per_cell + 1) / per_cell
    walk = np.stack([np.interp(way, range(len(corners)), axis) for axis in np.array(corners).T], 1)
    return walk + rng.normal(0, 0.1, walk.shape)
