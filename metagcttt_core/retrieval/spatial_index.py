"""Rows of a dataset by where they are: a sorted grid over one or two coordinates."""

from typing import NamedTuple

import numpy as np


class Neighbours(NamedTuple):
    """Rows near a point, ascending, and their distances."""

    rows: np.ndarray
    distances: np.ndarray


class SpatialIndex:
    """Finds every row within a radius without touching the rest of the dataset.

    Rows are sorted by the cell of their first two position coordinates. A query reads the cells
    that overlap the ball and then checks the exact Euclidean distance, in float64, over all
    position coordinates. Costs 12 to 16 bytes a row.
    """

    def __init__(
        self,
        observations: np.ndarray,
        position_dims: tuple[int, ...],
        scale: tuple[float, ...] | None,
        cell_size: float,
    ) -> None:
        """Sort the rows of `observations` (N, obs_dim) into cells of `cell_size` (scaled)."""
        self._observations = observations
        self._dims = list(position_dims)
        self._scale = np.ones(len(self._dims)) if scale is None else np.asarray(scale, np.float64)
        self._cell_size = cell_size
        planar = self._planar(observations[:, self._dims[:2]])
        self._origin = planar.min(axis=0)
        self._extent = planar.max(axis=0)
        cells = self._cells(planar)
        self._stride = int(cells[:, 1].max()) + 1
        keys = cells[:, 0] * self._stride + cells[:, 1]
        order = np.argsort(keys, kind='stable')
        self._order = order.astype(np.int32 if len(order) < 2**31 else np.int64)
        self._sorted_positions = np.ascontiguousarray(observations[:, self._dims[:2]][order])
        self._keys, starts = np.unique(keys[order], return_index=True)
        self._starts = np.append(starts, len(order))

    @property
    def num_bytes(self) -> int:
        """Memory that the index holds."""
        arrays = (self._order, self._sorted_positions, self._keys, self._starts)
        return sum(array.nbytes for array in arrays)

    def ball(self, point: np.ndarray, radius: float, *, strict: bool = False) -> Neighbours:
        """Rows whose distance to `point` is at most `radius` (below it when `strict`).

        Args:
            point: (position dims,) in the units of the observations.
            radius: In scaled units.
            strict: Exclude the boundary.
        """
        point = np.asarray(point, np.float64)
        slots = self._candidates(self._planar(point[None, :2])[0], radius)
        rows = self._order[slots].astype(np.int64)
        if len(self._dims) <= 2:
            positions = self._sorted_positions[slots]
        else:
            positions = self._observations[rows][:, self._dims]
        distances = self.distances(positions, point)
        near = distances < radius if strict else distances <= radius
        rows, distances = rows[near], distances[near]
        ascending = np.argsort(rows)
        return Neighbours(rows[ascending], distances[ascending])

    def nearest(self, point: np.ndarray) -> int:
        """The row nearest to `point`, the first on ties."""
        point = np.asarray(point, np.float64)
        planar = self._planar(point[None, :2])[0]
        outside = np.maximum(self._origin - planar, planar - self._extent).max()
        radius = max(self._cell_size, outside)
        while not len((near := self.ball(point, radius)).rows):
            radius *= 2
        return int(near.rows[np.argmin(near.distances)])

    def distances(self, positions: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Scaled Euclidean distances (n,) of `positions` (n, dims) to `point` (dims,), float64."""
        difference = (np.asarray(positions, np.float64) - point) * self._scale
        return np.sqrt(np.square(difference).sum(axis=1))

    def _planar(self, positions: np.ndarray) -> np.ndarray:
        return np.asarray(positions, np.float64) * self._scale[:2]

    def _cells(self, planar: np.ndarray) -> np.ndarray:
        cells = np.floor((planar - self._origin) / self._cell_size).astype(np.int64)
        return cells if cells.shape[1] == 2 else np.pad(cells, ((0, 0), (0, 1)))

    def _candidates(self, planar: np.ndarray, radius: float) -> np.ndarray:
        """Slots of the sorted order in cells that overlap the ball's bounding square."""
        margin = radius * (1 + 1e-9) + 1e-9 * (np.abs(planar) + np.abs(self._origin)).max()
        low = np.maximum(planar - margin, self._origin)
        high = np.minimum(planar + margin, self._extent)
        if np.any(low > high):
            return np.empty(0, np.int64)
        (first_x, first_y), (last_x, last_y) = self._cells(np.stack([low, high]))
        columns = np.arange(first_x, last_x + 1) * self._stride
        begin = self._starts[np.searchsorted(self._keys, columns + first_y, side='left')]
        end = self._starts[np.searchsorted(self._keys, columns + last_y, side='right')]
        return np.concatenate([np.arange(b, e) for b, e in zip(begin, end, strict=True)])
