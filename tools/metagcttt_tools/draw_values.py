"""Draw what a critic thinks of each place of a maze, and where it is mistaken."""

from pathlib import Path
from typing import Any

from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import Settings
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from sim_bridge import make_simulator
from sim_bridge.maze_map import Cell, MazeMap, NEIGHBOURS

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.environment import environment_of
from metagcttt_tools.common.results import beside, markdown_table, write_report
from metagcttt_tools.common.session import sole_writer, use_threads

_DESCRIPTION = """Draw the value of each place of a maze for the goal of each task.

Example: metagcttt draw-values --checkpoint out/saw/checkpoint --dataset data/NAME.npz
The policy needs a critic (gciql, saw, crl with a value). Prints how well the values of cells rank
with their distance to the goal along the corridors, and the false peaks: cells away from the goal
that are worth more than all beside them, where a policy that follows the value stays. Writes
OUT.png and OUT.json."""


class DrawValuesSettings(Settings):
    """Settings of the program."""

    checkpoint: Path = Field(Path('out/pretrain/checkpoint'), description='the policy')
    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='where states come from'
    )
    rows: int = Field(50_000, ge=1, description='at most so many states, evenly spaced')
    seed: int = Field(0, ge=0, description='random seed of the goals')
    out: Path = Field(Path('out/values'), description='files to write, without suffix')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(DrawValuesSettings, _DESCRIPTION, 'draw-values', argv)
    use_threads(1)
    record, picture = beside(settings.out, '.json'), beside(settings.out, '.png')
    try:
        with sole_writer(record, record, picture):
            _run(settings, record, picture)
    except ValueError as error:
        fail(str(error))


def _run(settings: DrawValuesSettings, record: Path, picture: Path) -> None:
    from metagcttt_core import load_checkpoint

    from metagcttt_tools.common.plots import save, values_picture

    agent = load_checkpoint(settings.checkpoint)
    if agent.value_fn is None:
        raise ValueError(f'{settings.checkpoint}: {agent.name} has no critic, so no values')
    environment = environment_of(agent)
    dataset = TrajectoryDataset.load(settings.dataset)
    agent.check(dataset)
    spaced = np.linspace(0, dataset.num_rows - 1, min(settings.rows, dataset.num_rows))
    observations = dataset.observations[spaced.astype(np.int64)]
    with make_simulator(environment) as simulator:
        maze, position_dims = simulator.maze, simulator.spec.position_dims
        positions = observations[:, position_dims]
        try:
            cells = maze.cells(positions)
        except ValueError as error:
            raise ValueError(f'{settings.dataset} is not of {environment}: {error}') from error
        panels: list[dict[str, Any]] = []
        for task in simulator.tasks:
            goal = simulator.reset(task.task_id, settings.seed)[1]
            values = agent.value_fn(observations, goal)
            place = tuple(goal[list(position_dims)].tolist())
            of_cells = cell_values(maze, cells, values)
            peaks = false_peaks(maze, of_cells, maze.cell(*place))
            panels.append(
                {
                    'task': task.task_id,
                    'goal': place,
                    'values': values,
                    'peaks': [maze.center(*cell) for cell in peaks],
                    'rank_correlation': rank_correlation(maze, of_cells, maze.cell(*place)),
                }
            )
    rows = [
        {
            'task': panel['task'],
            'rank correlation': f'{panel["rank_correlation"]:.2f}',
            'false peaks at (m)': '; '.join(f'{x:g}, {y:g}' for x, y in panel['peaks']),
        }
        for panel in panels
    ]
    results = [
        {name: figure for name, figure in panel.items() if name != 'values'} for panel in panels
    ]
    write_report(record, settings, {'tasks': results})
    save(values_picture(maze, positions, panels), picture)
    print(markdown_table(rows))
    print(f'picture: {picture}')


def cell_values(
    maze: MazeMap, cells: NDArray[np.int64], values: NDArray[np.floating[Any]]
) -> NDArray[np.float64]:
    """Mean value of the states in each cell, (rows, cols); NaN where there are none.

    Args:
        maze: The maze.
        cells: Of the states, (n, 2).
        values: (n,).
    """
    sums, counts = np.zeros((2, *maze.walls.shape))
    np.add.at(sums, tuple(cells.T), values)
    np.add.at(counts, tuple(cells.T), 1)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def false_peaks(maze: MazeMap, of_cells: NDArray[np.float64], goal: Cell) -> list[Cell]:
    """Free cells but the goal's that are worth more than every cell beside them."""
    padded = np.pad(np.where(maze.walls, np.nan, of_cells), 1, constant_values=np.nan)
    around = np.fmax.reduce([np.roll(padded, step, axis=(0, 1)) for step in NEIGHBOURS])[
        1:-1, 1:-1
    ]
    peaks = [(int(row), int(column)) for row, column in np.argwhere(of_cells > around)]
    return [cell for cell in peaks if cell != goal and not maze.walls[cell]]


def rank_correlation(maze: MazeMap, of_cells: NDArray[np.float64], goal: Cell) -> float:
    """Spearman's, of value and nearness to the goal along the corridors, over the free cells."""
    from scipy.stats import spearmanr

    known = ~maze.walls & ~np.isnan(of_cells)
    return float(spearmanr(of_cells[known], -maze.distances(goal)[known]).statistic)
