"""The mazes of gymnasium-robotics as data, so that plans and specs need no physics.

The tables restate `gymnasium_robotics/envs/maze/maps.py` and the package's registrations;
`tests/sim/test_robotics_layouts.py` compares every entry with the package's own environments.
"""

from dataclasses import dataclass

from sim_bridge.maze_map import Cell, MazeMap
from sim_bridge.mazes.ogbench_layouts import LAYOUTS as OGBENCH_LAYOUTS
from sim_bridge.mazes.ogbench_layouts import TASK_CELLS as OGBENCH_TASK_CELLS

SUCCESS_M = 0.45

LAYOUTS: dict[str, tuple[str, ...]] = {
    'UMaze': ('#####', '#...#', '###.#', '#...#', '#####'),
    'Open': ('#######', '#.....#', '#.....#', '#.....#', '#######'),
    'Open_Diverse_G': ('#######', '#rgggg#', '#ggggg#', '#ggggg#', '#######'),
    'Open_Diverse_GR': ('#######', '#ccccc#', '#ccccc#', '#ccccc#', '#######'),
    'Medium': OGBENCH_LAYOUTS['medium'],
    'Medium_Diverse_G': (
        '########',
        '#r.##..#',
        '#..#..g#',
        '##...###',
        '#..#...#',
        '#g#..#.#',
        '#...#g.#',
        '########',
    ),
    'Medium_Diverse_GR': (
        '########',
        '#c.##..#',
        '#..#..c#',
        '##...###',
        '#..#...#',
        '#c#..#.#',
        '#...#c.#',
        '########',
    ),
    'Large': OGBENCH_LAYOUTS['large'],
    'Large_Diverse_G': (
        '############',
        '#r...#g....#',
        '#.##.#.#.#.#',
        '#....g.#..g#',
        '#.####.###.#',
        '#.g#.#.....#',
        '##.#.#.#.###',
        '#..#g.g#.g.#',
        '############',
    ),
    'Large_Diverse_GR': (
        '############',
        '#c...#c....#',
        '#.##.#.#.#.#',
        '#....c.#..c#',
        '#.####.###.#',
        '#.c#.#.....#',
        '##.#.#.#.###',
        '#..#c.c#.c.#',
        '############',
    ),
}
"""Rows from the largest y down. In letters: r a start, g a goal, c both; else any free cell."""

TASK_CELLS: dict[str, tuple[tuple[Cell, Cell], ...]] = {
    'UMaze': (((1, 1), (3, 1)), ((3, 1), (1, 1)), ((1, 1), (3, 3)), ((3, 1), (1, 3))),
    'Open': (((1, 1), (3, 5)), ((3, 1), (1, 5)), ((1, 5), (3, 1)), ((3, 5), (1, 1))),
    'Medium': OGBENCH_TASK_CELLS['medium'],
    'Large': OGBENCH_TASK_CELLS['large'],
}
"""Start and goal of each task where any free cell may be one; OGBench's where it has the maze."""


@dataclass(frozen=True)
class Robot:
    """Properties common to the mazes of one robot.

    Attributes:
        obs_dim: Numbers in an observation, x and y included.
        act_dim: Numbers in an action.
        unit_m: Edge length of a cell, metres.
        control_period_s: Simulated seconds per control step.
        max_episode_steps: Limit by size of the maze.
    """

    obs_dim: int
    act_dim: int
    unit_m: float
    control_period_s: float
    max_episode_steps: dict[str, int]


_POINT_STEPS = {'UMaze': 300, 'Open': 300, 'Medium': 600, 'Large': 800}
_ANT_STEPS = {'UMaze': 700, 'Open': 700, 'Medium': 1000, 'Large': 1000}

ROBOTS: dict[tuple[str, str], Robot] = {
    ('PointMaze', 'v3'): Robot(4, 2, 1.0, 0.01, _POINT_STEPS),
    ('AntMaze', 'v3'): Robot(29, 8, 4.0, 0.05, _ANT_STEPS),
    ('AntMaze', 'v4'): Robot(29, 8, 4.0, 0.05, _ANT_STEPS),
    ('AntMaze', 'v5'): Robot(107, 8, 4.0, 0.05, _ANT_STEPS),
}
"""By name of the family and version."""


def plan_of(layout: str, unit_m: float) -> MazeMap:
    """Plan of a maze, centered on the origin; its row 0 has the smallest y."""
    rows = [''.join('#' if c == '#' else '.' for c in row) for row in LAYOUTS[layout][::-1]]
    height, width = len(rows), len(rows[0])
    origin_xy = ((1 - width) * unit_m / 2, (1 - height) * unit_m / 2)
    return MazeMap.from_rows(rows, unit_m=unit_m, origin_xy=origin_xy)


def flip(layout: str, cell: Cell) -> Cell:
    """The cell of the plan for a cell of the package, whose row 0 has the largest y, or back."""
    return len(LAYOUTS[layout]) - 1 - cell[0], cell[1]


def task_cells(layout: str, maze: MazeMap) -> tuple[tuple[Cell, Cell], ...]:
    """Start and goal of each task as cells of the plan.

    Where the maze names its goals, each is a task that begins at the start farthest from it (the
    first on ties).
    """
    if layout in TASK_CELLS:
        return tuple(
            (flip(layout, start), flip(layout, goal)) for start, goal in TASK_CELLS[layout]
        )
    starts, goals = _marked(layout, 'rc'), _marked(layout, 'gc')
    return tuple(
        (max(starts, key=lambda start: maze.distances(goal)[start]), goal) for goal in goals
    )


def _marked(layout: str, letters: str) -> list[Cell]:
    return [
        flip(layout, (i, j))
        for i, row in enumerate(LAYOUTS[layout])
        for j, letter in enumerate(row)
        if letter in letters
    ]
