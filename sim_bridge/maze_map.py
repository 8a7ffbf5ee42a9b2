"""The plan of a maze: walls, cell geometry and shortest paths."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Cell = tuple[int, int]
"""Row and column of a cell, counted from 0 at the corner with the smallest y and x."""

# The order breaks ties between shortest paths, as in OGBench.
NEIGHBOURS: tuple[Cell, ...] = ((-1, 0), (0, -1), (1, 0), (0, 1))


@dataclass(frozen=True, eq=False)
class MazeMap:
    """A maze of square cells in the x-y plane, without physics.

    Rows run along y and columns along x, so cell (i, j) has its centre at
    ``origin_xy + unit_m * (j, i)``. A cell owns its lower and left edge, not its upper and right.

    Attributes:
        walls: True where a cell is wall, shape (rows, cols), bool, read-only.
        unit_m: Edge length of a cell in metres.
        origin_xy: Center (x, y) of cell (0, 0) in metres.

    Example:
        >>> maze = MazeMap.from_rows(('####', '#..#', '####'), unit_m=4.0, origin_xy=(-4.0, -4.0))
        >>> maze.center(1, 2)
        (4.0, 0.0)
        >>> maze.cell(4.1, 0.3)
        (1, 2)
    """

    walls: NDArray[np.bool_]
    unit_m: float
    origin_xy: tuple[float, float]
    _distances: dict[Cell, NDArray[np.int64]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Check the table and keep a read-only copy of it."""
        walls = np.array(self.walls, dtype=bool)
        if walls.ndim != 2 or walls.size == 0:
            raise ValueError(f'walls must be a table of rows and columns, got shape {walls.shape}')
        if not (math.isfinite(self.unit_m) and self.unit_m > 0):
            raise ValueError(f'unit_m must be a positive length in metres, got {self.unit_m}')
        walls.flags.writeable = False
        object.__setattr__(self, 'walls', walls)

    @classmethod
    def from_rows(
        cls, rows: Sequence[str], unit_m: float, origin_xy: tuple[float, float]
    ) -> 'MazeMap':
        """Build a map from text, one string per row: ``#`` is wall, ``.`` is free.

        Raises:
            ValueError: If the rows differ in length or hold another character.
        """
        if len({len(row) for row in rows}) != 1:
            raise ValueError(f'rows must be equally long, got {[len(row) for row in rows]}')
        strange = sorted(set(''.join(rows)) - set('#.'))
        if strange:
            raise ValueError(f"rows may hold only '#' and '.', got {strange}")
        walls = np.array([[character == '#' for character in row] for row in rows])
        return cls(walls=walls, unit_m=unit_m, origin_xy=origin_xy)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Outer edges of the maze as (xmin, xmax, ymin, ymax) in metres."""
        rows, cols = self.walls.shape
        xmin = self.origin_xy[0] - self.unit_m / 2
        ymin = self.origin_xy[1] - self.unit_m / 2
        return xmin, xmin + cols * self.unit_m, ymin, ymin + rows * self.unit_m

    def contains(self, x: float, y: float) -> bool:
        """True if the point (x, y), in metres, lies in some cell, wall or free."""
        xmin, xmax, ymin, ymax = self.extent
        return xmin <= x < xmax and ymin <= y < ymax

    def cell(self, x: float, y: float) -> Cell:
        """Cell (i, j) that holds the point (x, y), in metres.

        Raises:
            ValueError: If the point lies outside the maze or is not finite.
        """
        xmin, xmax, ymin, ymax = self.extent
        if not self.contains(x, y):
            raise ValueError(
                f'point ({x}, {y}) lies outside the maze, which spans x {xmin} to {xmax} '
                f'and y {ymin} to {ymax} metres'
            )
        rows, cols = self.walls.shape
        i, j = int((y - ymin) / self.unit_m), int((x - xmin) / self.unit_m)
        # Rounding can lift a point just below the upper edge into a cell that does not exist.
        return min(i, rows - 1), min(j, cols - 1)

    def center(self, i: int, j: int) -> tuple[float, float]:
        """Centre (x, y) of cell (i, j) in metres.

        Raises:
            ValueError: If there is no such cell.
        """
        self._check_cell((i, j))
        return self.origin_xy[0] + j * self.unit_m, self.origin_xy[1] + i * self.unit_m

    def is_free(self, x: float, y: float) -> bool:
        """True if the point (x, y), in metres, lies in a free cell."""
        return self.contains(x, y) and not self.walls[self.cell(x, y)]

    def count_visits(self, points: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
        """Number of points, (n, 2) in metres, per cell, shape (rows, cols).

        Raises:
            ValueError: If a point lies outside the maze; names the first.
        """
        counts = np.zeros(self.walls.shape, dtype=np.int64)
        np.add.at(counts, tuple(self.cells(points).T), 1)
        return counts

    def cells(self, points: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
        """Cells (i, j) that hold points, both of shape (n, 2); points in metres.

        Raises:
            ValueError: If a point lies outside the maze; names the first.
        """
        xmin, _, ymin, _ = self.extent
        cells = np.floor((points[:, ::-1] - (ymin, xmin)) / self.unit_m)
        inside = ((cells >= 0) & (cells < self.walls.shape)).all(axis=1)
        if not inside.all():
            self.cell(*points[np.flatnonzero(~inside)[0]].tolist())
        return cells.astype(np.int64)

    def free_cells(self) -> list[Cell]:
        """All free cells, row by row."""
        return [(int(i), int(j)) for i, j in np.argwhere(~self.walls)]

    def open_cells(self) -> list[Cell]:
        """Free cells that are not corridors, row by row.

        A corridor cell has exactly two free neighbours, on opposite sides; OGBench never draws
        one as the goal of a navigate episode.
        """
        return [cell for cell in self.free_cells() if not self._is_corridor(cell)]

    def cells_at_distance(self, start: Cell, steps: int) -> list[Cell]:
        """Free cells at a shortest-path distance of exactly `steps` cells from `start`."""
        table = self.distances(start)
        return [(int(i), int(j)) for i, j in np.argwhere(table == steps)]

    def distances(self, target: Cell) -> NDArray[np.int64]:
        """Shortest-path distance in cells from each cell to `target`, (rows, cols); -1: none.

        Paths go up, down, left and right through free cells (breadth-first search). The result
        is cached per target and read-only.

        Raises:
            ValueError: If there is no such cell.
        """
        self._check_cell(target)
        if target not in self._distances:
            self._distances[target] = self._search(target)
        return self._distances[target]

    def next_cell(self, start: Cell, target: Cell) -> Cell:
        """The next cell on the shortest path from `start` to `target`.

        Of two equally near neighbours it is the first in the order row before, column before,
        row after, column after, as in OGBench's `get_oracle_subgoal`; `start` itself when it is
        the target or cannot reach it.
        """
        table = self.distances(target)
        best = start
        for di, dj in NEIGHBOURS:
            neighbour = (start[0] + di, start[1] + dj)
            if self._is_free_cell(neighbour) and table[neighbour] < table[best]:
                best = neighbour
        return best

    def waypoint(self, start: Cell, goal: tuple[float, float]) -> tuple[float, float]:
        """Point (x, y) to head for in `start`: the next cell's centre, or the goal in its cell.

        Raises:
            ValueError: If the goal lies outside the maze.
        """
        target = self.cell(*goal)
        return goal if start == target else self.center(*self.next_cell(start, target))

    def _search(self, target: Cell) -> NDArray[np.int64]:
        table = np.full(self.walls.shape, -1, dtype=np.int64)
        table[target] = 0
        queue = deque([target])
        while queue:
            i, j = queue.popleft()
            for di, dj in NEIGHBOURS:
                neighbour = (i + di, j + dj)
                if self._is_free_cell(neighbour) and table[neighbour] == -1:
                    table[neighbour] = table[i, j] + 1
                    queue.append(neighbour)
        table.flags.writeable = False
        return table

    def _has_cell(self, cell: Cell) -> bool:
        return 0 <= cell[0] < self.walls.shape[0] and 0 <= cell[1] < self.walls.shape[1]

    def _is_free_cell(self, cell: Cell) -> bool:
        return self._has_cell(cell) and not self.walls[cell]

    def _is_corridor(self, cell: Cell) -> bool:
        i, j = cell
        before, after = self._is_free_cell((i - 1, j)), self._is_free_cell((i + 1, j))
        left, right = self._is_free_cell((i, j - 1)), self._is_free_cell((i, j + 1))
        return (before, after, left, right) in (
            (True, True, False, False),
            (False, False, True, True),
        )

    def _check_cell(self, cell: Cell) -> None:
        if not self._has_cell(cell):
            rows, cols = self.walls.shape
            raise ValueError(f'cell {cell} does not exist; the maze has {rows} x {cols} cells')
