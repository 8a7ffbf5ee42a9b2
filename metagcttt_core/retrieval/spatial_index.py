"""Spatial index of dataset rows: a sorted grid over one or two coordinates."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from metagcttt_core.kernels import kernels_if_any

_MOST_CELLS = 2**30


class Neighbours(NamedTuple):
    """Rows near a point, in no particular order, and their distances."""

    rows: np.ndarray
    distances: np.ndarray


@dataclass(frozen=True)
class Ball:
    """The rows within a radius of a point; see `SpatialIndex`."""

    index: 'SpatialIndex'
    point: np.ndarray
    radius: float

    def __call__(self, *, strict: bool = False) -> Neighbours:
        """All of them."""
        return self.index.ball(self.point, self.radius, strict=strict)

    def nearest_per_episode(
        self, first_usable: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Of each trajectory the one nearest to the point."""
        return self.index.nearest_per_episode(self.point, self.radius, first_usable)


_NOTHING = Neighbours(np.empty(0, np.int64), np.empty(0))


class SpatialIndex:
    """Finds every row within a radius without touching the rest of the dataset.

    Rows are sorted by the cell of their first two position coordinates. A query reads the cells
    that overlap the ball and then checks the exact Euclidean distance, in float64, over all
    position coordinates. Costs 16 to 20 bytes a row.
    """

    def __init__(
        self,
        observations: np.ndarray,
        position_dims: tuple[int, ...],
        scale: tuple[float, ...] | None,
        cell_size: float,
        episodes: np.ndarray | None = None,
    ) -> None:
        """Sort rows into cells.

        Args:
            observations: (N, obs_dim).
            position_dims: The coordinates that distances use.
            scale: Factor of each of them; 1 by default.
            cell_size: Edge of the cells, in scaled units.
            episodes: (N,) the trajectory of each row, ascending, for `nearest_per_episode`.
        """
        self._observations = observations
        self._dims = list(position_dims)
        self._scale = np.ones(len(self._dims)) if scale is None else np.asarray(scale, np.float64)
        self._cell_size = cell_size
        columns = [self._observations[:, dim] for dim in self._dims[:2]]
        planar = [column * factor for column, factor in zip(columns, self._scale, strict=False)]
        self._origin = np.array([values.min() for values in planar])
        self._extent = np.array([values.max() for values in planar])
        # Far outliers must not create more cells than an integer can number.
        self._edges = np.maximum(self._cell_size, (self._extent - self._origin) / _MOST_CELLS)
        cells = [self._cell(values, axis) for axis, values in enumerate(planar)]
        self._stride = int(cells[1].max()) + 1 if len(cells) == 2 else 1
        keys = cells[0] * self._stride + (cells[1] if len(cells) == 2 else 0)
        order = np.argsort(keys, kind='stable')
        self._order = order.astype(np.int32 if len(order) < 2**31 else np.int64)
        self._columns = [column[order] for column in columns]
        self._episodes = None if episodes is None else episodes[order].astype(np.int32)
        self._num_episodes = 0 if episodes is None else int(episodes[-1]) + 1
        self._kernels = kernels_if_any()
        self._keys, starts = np.unique(keys[order], return_index=True)
        self._starts = np.append(starts, len(order))
        # Columns of cells that hold any row: a wide ball over a fine grid passes many that do not.
        self._occupied = np.unique(self._keys // self._stride)

    @property
    def num_bytes(self) -> int:
        """Memory that the index holds."""
        arrays = (self._order, self._keys, self._starts, self._occupied, *self._columns)
        episodes = 0 if self._episodes is None else self._episodes.nbytes
        return sum(array.nbytes for array in arrays) + episodes

    def ball(self, point: np.ndarray, radius: float, *, strict: bool = False) -> Neighbours:
        """Rows whose distance to `point` is at most `radius` (below it when `strict`).

        Args:
            point: (position dims,) in the units of the observations.
            radius: In scaled units.
            strict: Exclude the boundary.
        """
        point = np.asarray(point, np.float64)
        parts = self._parts(point, radius)
        found = [_NOTHING, *(self._near(part, point, radius, strict) for part in parts)]
        return Neighbours(*(np.concatenate(arrays) for arrays in zip(*found, strict=True)))

    def _near(self, part: slice, point: np.ndarray, radius: float, strict: bool) -> Neighbours:
        """The rows of one run of sorted rows that lie in the ball."""
        distances = self._distances([column[part] for column in self._columns], point)
        rows = self._order[part]
        if len(self._dims) > 2:
            # In all coordinates a point is at least as far as in two of them.
            rows = rows[distances <= radius * (1 + 1e-9)]
            positions = self._observations[rows][:, self._dims]
            distances = self._distances(list(positions.T), point)
        near = np.flatnonzero(distances < radius if strict else distances <= radius)
        return Neighbours(rows[near].astype(np.int64), distances[near])

    def nearest_per_episode(
        self, point: np.ndarray, radius: float, first_usable: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Of each trajectory the row nearest to `point`, the first on ties, within `radius`.

        Args:
            point: (position dims,) in the units of the observations.
            radius: In scaled units.
            first_usable: (trajectories,) int64, the first row of each that counts; all by default.

        Returns:
            Trajectories, ascending, with rows and distances, (n,) each; the same, in one reading
            of the ball, as from `ball`. None without kernels, or for more than two coordinates.
        """
        kernels, order, episodes = self._kernels, self._order, self._episodes
        if kernels is None or episodes is None or len(self._dims) > 2 or order.itemsize > 4:
            return None
        point = np.asarray(point, np.float64)
        parts = self._parts(point, radius)
        starts = np.array([part.start for part in parts], np.int64)
        stops = np.array([part.stop for part in parts], np.int64)
        columns = np.array([column.ctypes.data for column in self._columns], np.uint64)
        distances = np.full(self._num_episodes, np.inf)
        rows = np.zeros(self._num_episodes, np.int64)
        kernels.nearest_per_episode(
            len(parts),
            *(array.ctypes.data for array in (starts, stops, columns)),
            len(columns),
            *(array.ctypes.data for array in (point, self._scale)),
            radius,
            *(array.ctypes.data for array in (order, episodes)),
            None if first_usable is None else first_usable.ctypes.data,
            *(array.ctypes.data for array in (distances, rows)),
        )
        found = np.flatnonzero(distances < np.inf)
        return found, rows[found], distances[found]

    def nearest(self, point: np.ndarray) -> int:
        """The row nearest to `point`, the first on ties."""
        point = np.asarray(point, np.float64)
        planar = (point * self._scale)[:2]
        outside = np.maximum(self._origin - planar, planar - self._extent).max()
        radius = max(self._cell_size, outside)
        while not len((near := self.ball(point, radius)).rows):
            radius *= 2
        return int(near.rows[near.distances == near.distances.min()].min())

    def _distances(self, columns: list[np.ndarray], point: np.ndarray) -> np.ndarray:
        """Scaled Euclidean distances (n,), float64, of points given by coordinate to `point`."""
        squared = np.zeros(len(columns[0]))
        for column, center, factor in zip(columns, point, self._scale, strict=False):
            difference = column - center
            difference *= factor
            difference *= difference
            squared += difference
        return np.sqrt(squared, out=squared)

    def _cell(self, values: np.ndarray, axis: int) -> np.ndarray:
        return np.floor((values - self._origin[axis]) / self._edges[axis]).astype(np.int64)

    def _parts(self, point: np.ndarray, radius: float) -> list[slice]:
        """Runs of the sorted rows, of all cells that overlap the ball."""
        planar = (point * self._scale)[:2]
        slack = 1e-9 * (np.abs(planar) + np.abs(self._origin)).max()
        margin = radius * (1 + 1e-9) + slack
        low = np.maximum(planar - margin, self._origin)
        high = np.minimum(planar + margin, self._extent)
        if np.any(low > high):
            return []
        first, last = (int(self._cell(edge[0], 0)) for edge in (low, high))
        columns = self._occupied[slice(*np.searchsorted(self._occupied, [first, last + 1]))]
        in_column = self._chords(columns, planar, margin, slack) if len(planar) == 2 else (0, 0)
        begin = self._starts[np.searchsorted(self._keys, columns * self._stride + in_column[0])]
        end = np.searchsorted(self._keys, columns * self._stride + in_column[1], side='right')
        return [slice(a, b) for a, b in zip(begin, self._starts[end], strict=True) if a < b]

    def _chords(
        self, columns: np.ndarray, planar: np.ndarray, radius: float, slack: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The first and the last cell of each column that the ball reaches."""
        left = self._origin[0] + columns * self._edges[0]
        away = np.maximum(left - planar[0], planar[0] - left - self._edges[0]) - slack
        half = np.sqrt(np.maximum(radius**2 - np.maximum(away, 0) ** 2, 0)) + slack
        low, high = planar[1] - half, planar[1] + half
        lowest, highest = self._origin[1], self._extent[1]
        return self._cell(low.clip(lowest, highest), 1), self._cell(high.clip(lowest, highest), 1)
