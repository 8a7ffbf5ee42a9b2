"""OGBench's mazes and robots as data, so that plans and specs need no physics.

The tables restate the `ogbench` package (`ogbench/locomaze/maze.py` and its registrations);
`tests/sim/test_ogbench_layouts.py` compares every entry with the package's own environments.
"""

from dataclasses import dataclass

UNIT_M = 4.0
ORIGIN_XY = (-4.0, -4.0)

LAYOUTS: dict[str, tuple[str, ...]] = {
    'medium': (
        '########',
        '#..##..#',
        '#..#...#',
        '##...###',
        '#..#...#',
        '#.#..#.#',
        '#...#..#',
        '########',
    ),
    'large': (
        '############',
        '#....#.....#',
        '#.##.#.#.#.#',
        '#......#...#',
        '#.####.###.#',
        '#..#.#.....#',
        '##.#.#.#.###',
        '#..#...#...#',
        '############',
    ),
    'giant': (
        '################',
        '#.#......##....#',
        '#.#.##.#.#..##.#',
        '#...#..#...#...#',
        '#.###.######.#.#',
        '#...#...#....#.#',
        '###.#.#..#.#.###',
        '#...#..#...#...#',
        '#.#.#.######.#.#',
        '#.###...#...##.#',
        '#.....#...#....#',
        '################',
    ),
    'teleport': (
        '############',
        '#.....#.#..#',
        '##.#...#..##',
        '##.###.....#',
        '#....#.#.#.#',
        '#.##.#.#.#.#',
        '#.##.#.#.#.#',
        '#....#...#.#',
        '############',
    ),
}

TASK_CELLS: dict[str, tuple[tuple[tuple[int, int], tuple[int, int]], ...]] = {
    'medium': (
        ((1, 1), (6, 6)),
        ((6, 1), (1, 6)),
        ((5, 3), (4, 2)),
        ((6, 5), (6, 1)),
        ((2, 6), (1, 1)),
    ),
    'large': (
        ((1, 1), (7, 10)),
        ((5, 4), (7, 1)),
        ((7, 4), (1, 10)),
        ((3, 8), (5, 4)),
        ((1, 1), (5, 4)),
    ),
    'giant': (
        ((1, 1), (10, 14)),
        ((1, 14), (10, 1)),
        ((8, 14), (1, 1)),
        ((8, 3), (5, 12)),
        ((5, 9), (3, 8)),
    ),
    'teleport': (
        ((1, 10), (7, 1)),
        ((1, 1), (7, 10)),
        ((5, 6), (7, 10)),
        ((7, 1), (7, 10)),
        ((5, 6), (7, 1)),
    ),
}


@dataclass(frozen=True)
class Robot:
    """One family of mazes: the robot in it and OGBench's settings for it.

    Attributes:
        obs_dim: Length of an observation.
        act_dim: Numbers in an action.
        control_period_s: Simulated seconds per control step.
        goal_tolerance_m: Distance to the goal that counts as success.
        max_episode_steps: Step limit of a task episode, by the layouts there are for the robot.
    """

    obs_dim: int
    act_dim: int
    control_period_s: float
    goal_tolerance_m: float
    max_episode_steps: dict[str, int]

    @property
    def layouts(self) -> tuple[str, ...]:
        """Names of the layouts there are for the robot."""
        return tuple(self.max_episode_steps)


_SHORT = {'medium': 1000, 'large': 1000, 'giant': 1000, 'teleport': 1000}
# The package registers a teleport maze for the humanoid too, but its model does not compile: the
# humanoid's file lacks the materials of the teleports.
_LONG = {'medium': 2000, 'large': 2000, 'giant': 4000}

ROBOTS: dict[str, Robot] = {
    'pointmaze': Robot(2, 2, 0.1, 1.0, _SHORT),
    'antmaze': Robot(29, 8, 0.1, 0.5, _SHORT),
    'humanoidmaze': Robot(69, 21, 0.025, 0.5, _LONG),
}
