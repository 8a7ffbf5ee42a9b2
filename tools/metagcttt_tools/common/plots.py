"""Pictures of mazes, paths and success curves."""

from collections.abc import Mapping, Sequence
import io
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use('Agg')
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from metagcttt_core.files import atomic_write, PICTURE_MARK
import numpy as np
from sim_bridge.controllers.walk import Walk
from sim_bridge.maze_map import MazeMap

# Okabe and Ito's palette: told apart by colour-blind readers too.
COLORS = ('#D55E00', '#0072B2', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
_RETRIEVED = '#9a9a9a'
_MANY_LINES = 8


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
    """Write a picture, whole and with our mark."""
    content = io.BytesIO()  # first: a full disk shall leave no half of it
    mark = {'Software': PICTURE_MARK}
    figure.savefig(content, format='png', dpi=140, bbox_inches='tight', metadata=mark)
    with atomic_write(path) as file:
        file.write(content.getvalue())


def write_gif(path: Path, content: bytes) -> None:
    """Write a GIF, whole and with our mark as its comment."""
    comment = b'!\xfe' + bytes([len(PICTURE_MARK)]) + PICTURE_MARK.encode() + b'\0'
    with atomic_write(path) as file:
        file.write(content.removesuffix(b';') + comment + b';')


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


def coverage_picture(maze: MazeMap, positions: np.ndarray, bins_per_cell: int = 8) -> Figure:
    """Heat map of the visits to each place; positions of shape (N, 2) in metres."""
    counts = _sums(maze, positions, bins_per_cell)
    figure = Figure(figsize=(4.6, 4), layout='constrained')
    axes = figure.subplots()
    draw_maze(axes, maze)
    visited = np.ma.masked_equal(counts, 0)
    image = axes.imshow(visited, extent=maze.extent, origin='lower', norm='log', cmap='viridis')
    figure.colorbar(image, label=f'rows per square of {maze.unit_m / bins_per_cell:g} m')
    return figure


def values_picture(
    maze: MazeMap,
    positions: np.ndarray,
    tasks: Sequence[Mapping[str, Any]],
    bins_per_cell: int = 4,
) -> Figure:
    """Mean value of the states at each place, one panel a task.

    Args:
        maze: The maze.
        positions: Where the states are, (n, 2) metres.
        tasks: Each with `task` (its number), `values` (n,), `goal` and `peaks`, points in metres.
        bins_per_cell: Squares that a cell is divided into, along each side.
    """
    figure = Figure(figsize=(3.1 * len(tasks), 3.3), layout='constrained')
    counts = _sums(maze, positions, bins_per_cell)
    for axes, task in zip(np.atleast_1d(figure.subplots(1, len(tasks))), tasks, strict=True):
        draw_maze(axes, maze)
        sums = _sums(maze, positions, bins_per_cell, task['values'])
        means = np.ma.masked_invalid(sums / np.where(counts, counts, np.nan))
        image = axes.imshow(means, extent=maze.extent, origin='lower', cmap='viridis')
        figure.colorbar(image, location='bottom')
        axes.plot(*task['goal'], marker='*', color='gold', markeredgecolor='black', markersize=14)
        for peak in task['peaks']:
            axes.plot(*peak, marker='X', color=COLORS[0], markeredgecolor='white', markersize=10)
        axes.set_title(f'task {task["task"]}')
    return figure


def _sums(
    maze: MazeMap, positions: np.ndarray, bins_per_cell: int, values: np.ndarray | None = None
) -> np.ndarray:
    """Sum of values, or number, of the points in each square of the maze."""
    xmin, xmax, ymin, ymax = maze.extent
    bins = [bins_per_cell * count for count in maze.walls.shape]
    y, x = positions[:, 1], positions[:, 0]
    return np.histogram2d(y, x, bins, ((ymin, ymax), (xmin, xmax)), weights=values)[0]


def places_picture(places: np.ndarray, x_name: str, y_name: str) -> Figure:
    """How often each place was visited, without a map.

    Args:
        places: (N, 2) values along x and y.
        x_name: What x is.
        y_name: What y is.
    """
    figure = Figure(figsize=(5, 5), layout='constrained')
    axes = figure.subplots()
    counts = axes.hexbin(places[:, 0], places[:, 1], gridsize=60, bins='log', mincnt=1)
    axes.set(xlabel=x_name, ylabel=y_name)
    figure.colorbar(counts, label='rows')
    return figure


def controller_picture(walks: Sequence[Sequence[Walk]]) -> Figure:
    """Paths and speed along each direction; one sequence of walks a direction."""
    figure = Figure(figsize=(8.4, 3.8), layout='constrained')
    paths, speeds = figure.subplots(1, 2)
    for number, same_direction in enumerate(walks):
        color = COLORS[number % len(COLORS)]
        end = max(walk.distance_m for walk in same_direction) * same_direction[0].direction
        paths.plot((0, end[0]), (0, end[1]), color='black', linewidth=0.8, linestyle=':')
        for walk in same_direction:
            paths.plot(*(walk.path - walk.path[0]).T, color=color, linewidth=1)
        angle_deg = round(np.degrees(np.arctan2(*same_direction[0].direction[::-1]))) % 360
        mean = np.mean([walk.speed for walk in same_direction])
        speeds.bar(str(angle_deg), mean, color=color, alpha=0.5)
        speeds.scatter(
            [str(angle_deg)] * len(same_direction),
            [walk.speed for walk in same_direction],
            color=color,
            s=12,
        )
    paths.set_aspect('equal')
    paths.set_xlabel('x (m)')
    paths.set_ylabel('y (m)')
    speeds.set_xlabel('direction (degrees)')
    speeds.set_ylabel('speed along the direction (m/s)')
    return figure


def success_curves(adaptations: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Figure:
    """Success by steps of test-time training, one panel an adaptation, one line an arm.

    Args:
        adaptations: By name and arm: `budgets`, `success` and `standard_error`, equally long.
    """
    crowded = max(len(arms) for arms in adaptations.values()) > _MANY_LINES
    size = (0.6 + (6.0 if crowded else 4.4) * len(adaptations), 4.4 if crowded else 3.6)
    figure = Figure(figsize=size, layout='constrained')
    panels = np.atleast_1d(figure.subplots(1, len(adaptations), sharey=True))
    for axes, (name, arms) in zip(panels, adaptations.items(), strict=True):
        budgets = sorted({budget for curve in arms.values() for budget in curve['budgets']})
        for number, (arm, curve) in enumerate(arms.items()):
            positions = np.searchsorted(budgets, curve['budgets'])
            _success_line(axes, positions, curve, arm, number)
        axes.set_xticks(range(len(budgets)), [str(budget) for budget in budgets])
        axes.set_xlabel('steps of test-time training K')
        if len(adaptations) > 1:
            axes.set_title(name)
        if crowded:
            beside = {'loc': 'center left', 'bbox_to_anchor': (1, 0.5), 'fontsize': 'small'}
            axes.legend(frameon=False, **beside)
        elif len(arms) > 1:
            axes.legend(loc='best', frameon=False)
    panels[0].set_ylabel('success')
    return figure


def post_training_curves(curve: Mapping[str, Mapping[float, Mapping[str, Any]]]) -> Figure:
    """Success over post-training, one panel an arm, one line a budget (paper, figure 5).

    Args:
        curve: By arm and fraction of the outer steps: `budgets`, `success`, `standard_error`.
    """
    figure = Figure(figsize=(0.6 + 3 * len(curve), 3.2), layout='constrained')
    panels = np.atleast_1d(figure.subplots(1, len(curve), sharey=True))
    for axes, (arm, points) in zip(panels, curve.items(), strict=True):
        budgets = next(iter(points.values()))['budgets']
        for number, budget in enumerate(budgets):
            line = {
                name: [point[name][number] for point in points.values()]
                for name in ('success', 'standard_error')
            }
            fractions = 100 * np.array(list(points))
            _success_line(axes, fractions, line, f'K = {budget}', number)
        axes.set_xlabel('outer steps, percent')
        axes.set_title(arm)
    panels[0].set_ylabel('success')
    figure.legend(*panels[0].get_legend_handles_labels(), loc='outside right upper', frameon=False)
    return figure


def _success_line(
    axes: Axes, x: np.ndarray, curve: Mapping[str, Any], label: str, number: int
) -> None:
    mean, error = np.array(curve['success']), np.array(curve['standard_error'])
    draw_line(axes, x, (mean, mean - error, mean + error), label, number)
    axes.set_ylim(-0.02, 1.02)


def draw_line(
    axes: Axes, x: np.ndarray, values: tuple[np.ndarray, ...], label: str, number: int
) -> None:
    """Draw a line and the band around it.

    Args:
        axes: Where.
        x: Shape (points,).
        values: Line, lower and upper bound, each of shape (points,).
        label: Its name in the legend.
        number: Which line of the axes it is: the same number looks the same everywhere.
    """
    mean, low, high = values
    color, style = COLORS[number % len(COLORS)], _choose(('-', '--', ':', '-.'), number)
    axes.plot(x, mean, color=color, linestyle=style, marker='o', markersize=3.5, label=label)
    axes.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
    axes.grid(alpha=0.25)


def _choose(looks: tuple[str, ...], number: int) -> str:
    """What tells apart, in black and white too, the lines that share a color."""
    return looks[number // len(COLORS) % len(looks)]


def interquartile_picture(adaptations: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Interquartile means and probabilities of improvement by budget, with their intervals.

    Args:
        adaptations: By name of the adaptation and of the arm its summary, with `robust`.
    """
    rows = len(adaptations)
    height = max(3.4, *(0.24 * len(arms) for arms in adaptations.values()))  # of the legend
    figure = Figure(figsize=(11, height * rows), layout='constrained')
    panels = figure.subplots(rows, 2, squeeze=False)
    for row, (name, arms) in zip(panels, adaptations.items(), strict=True):
        for number, (arm, summary) in enumerate(arms.items()):
            places = np.arange(len(summary['budgets']))
            shift = 0.8 / len(arms) * (number - (len(arms) - 1) / 2)
            for axes, figures in zip(row, ('interquartile_mean', 'improvement'), strict=True):
                if figures in summary.get('robust', {}):
                    value, low, high = np.array(summary['robust'][figures]).T
                    axes.errorbar(
                        places + shift,
                        value,
                        yerr=(value - low, high - value),
                        color=COLORS[number % len(COLORS)],
                        label=arm,
                        marker=_choose(('o', 's', '^', 'D'), number),
                        markersize=4,
                        linestyle='',
                    )
                axes.set_xticks(places, [str(budget) for budget in summary['budgets']])
                axes.set_xlabel('test-time training steps K')
                axes.set_ylim(-0.03, 1.03)
        row[0].set_title(f'{name}: interquartile mean of success')
        row[1].legend(
            *row[0].get_legend_handles_labels(),
            loc='upper left',
            bbox_to_anchor=(1, 1),
            frameon=False,
            fontsize='small',
        )
        row[1].set_title('probability of improvement over the base')
        row[1].axhline(0.5, color='grey', linewidth=0.8)
    return figure
