"""Pictures of mazes, paths and success curves."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use('Agg')
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
import numpy as np
from sim_bridge.maze_map import MazeMap

# Okabe and Ito's palette: told apart by colour-blind readers too.
COLORS = ('#D55E00', '#0072B2', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
_RETRIEVED = '#9a9a9a'


def draw_maze(axes: Axes, maze: MazeMap) -> None:
    """Walls dark, free space white, axes in metres without ticks."""
    axes.imshow(maze.walls, cmap='Greys', vmin=0, vmax=1.35, extent=maze.extent, origin='lower')
    axes.set_xticks([])
    axes.set_yticks([])


def draw_segments(axes: Axes, segments: Sequence[np.ndarray]) -> None:
    """Retrieved sub-trajectories, each (n, 2) in metres, as thin grey lines."""
    axes.add_collection(
        LineCollection(list(segments), colors=_RETRIEVED, linewidths=0.9, alpha=0.8)
    )


def save(figure: Figure, path: Path) -> None:
    """Write a picture and forget the figure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=140, bbox_inches='tight')


def demo_picture(
    maze: MazeMap,
    paths: Mapping[str, Sequence[np.ndarray]],
    successes: Mapping[str, Sequence[bool]],
    segments: Sequence[Sequence[np.ndarray]],
    goals: Sequence[tuple[float, float]],
) -> Figure:
    """One panel a task: walls, what the filter retrieved, and the path of each arm.

    Args:
        maze: The maze.
        paths: By arm, one (T, 2) path a task, metres.
        successes: By arm, whether each task's goal was reached.
        segments: The retrieved sub-trajectories of each task.
        goals: The goal of each task.
    """
    figure = Figure(figsize=(3 * len(goals), 3.7), layout='constrained')
    panels = np.atleast_1d(figure.subplots(1, len(goals)))
    for task, (axes, goal) in enumerate(zip(panels, goals, strict=True)):
        draw_maze(axes, maze)
        draw_segments(axes, segments[task])
        for color, (arm, arm_paths) in zip(COLORS, paths.items(), strict=False):
            path = arm_paths[task]
            reached = successes[arm][task]
            style = '-' if reached else (0, (2, 1))
            axes.plot(*path.T, color=color, linewidth=1.6, linestyle=style)
            axes.plot(*path[-1], marker='o' if reached else 'x', color=color, markersize=5)
        start = next(iter(paths.values()))[task][0]
        axes.plot(*start, marker='o', color='black', markersize=6)
        axes.plot(*goal, marker='*', color='gold', markeredgecolor='black', markersize=14)
        axes.set_title(f'task {task + 1}')
    handles = [
        Line2D([], [], color='black', marker='o', linestyle='', label='start'),
        Line2D(
            [],
            [],
            color='gold',
            marker='*',
            markeredgecolor='black',
            markersize=11,
            linestyle='',
            label='goal',
        ),
        Line2D([], [], color=_RETRIEVED, linewidth=1, label='retrieved sub-trajectories'),
        *(
            Line2D([], [], color=color, label=arm)
            for color, arm in zip(COLORS, paths, strict=False)
        ),
        Line2D([], [], color='black', linestyle=(0, (2, 1)), label='goal not reached'),
    ]
    figure.legend(handles=handles, loc='outside lower center', ncols=len(handles), frameon=False)
    return figure
