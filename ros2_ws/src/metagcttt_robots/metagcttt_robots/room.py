"""The room of the robot with two wheels: obstacles on a grid of half metres."""

import numpy as np
from numpy.typing import NDArray

ROOM = """
################
#......#.......#
#......#.......#
#..##..#..##...#
#...#.....#....#
#...#.....#....#
#...####..#..###
#..............#
#..............#
####..######...#
#.........#....#
#.........#....#
#..####...#....#
#..#...........#
#..#......#....#
################
""".split()
"""Seen from above: x to the right, y up; `#` is an obstacle."""
UNIT_M = 0.5
CELLS_PER_UNIT = 5
START = (-2.75, -2.75, 0.0)
"""Where the robot starts: x, y in metres, yaw in radians."""


def obstacles() -> NDArray[np.bool_]:
    """The plan: rows along y from the lowest one, columns along x; True is an obstacle."""
    return np.array([[cell == '#' for cell in row] for row in reversed(ROOM)])


def lower_corner() -> tuple[float, float]:
    """The corner of smallest x and y in metres; the origin is in the middle of the room."""
    rows, columns = obstacles().shape
    return -columns * UNIT_M / 2, -rows * UNIT_M / 2


def boxes() -> list[tuple[float, float, float, float]]:
    """The obstacles as few boxes: centre x, y and half sizes in metres, one for a run in a row."""
    found = []
    left, bottom = lower_corner()
    for row, line in enumerate(obstacles()):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        for start, stop in edges.reshape(-1, 2):
            x = left + (start + stop) / 2 * UNIT_M
            y = bottom + (row + 0.5) * UNIT_M
            found.append((x, y, (stop - start) / 2 * UNIT_M, UNIT_M / 2))
    return found
