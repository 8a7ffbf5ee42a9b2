"""Shortest paths on an occupancy grid, away from obstacles."""

import heapq

import numpy as np
from numpy.typing import NDArray

_MOVES = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


def inflate(occupied: NDArray[np.bool_], cells: int) -> NDArray[np.bool_]:
    """Obstacles and what is within so many cells of them, diagonals counted as one."""
    padded = np.pad(occupied, cells, constant_values=True)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * cells + 1,) * 2)
    return np.asarray(windows.any(axis=(2, 3)))


def shortest_path(
    occupied: NDArray[np.bool_], start: tuple[int, int], goal: tuple[int, int]
) -> list[tuple[int, int]]:
    """Cells from start to goal by Dijkstra's algorithm; empty when there is no way."""
    costs = {start: 0.0}
    before: dict[tuple[int, int], tuple[int, int]] = {}
    queue = [(0.0, start)]
    while queue:
        cost, cell = heapq.heappop(queue)
        if cell == goal:
            path = [cell]
            while cell in before:
                cell = before[cell]
                path.append(cell)
            return path[::-1]
        if cost > costs[cell]:
            continue
        for i, j in _MOVES:
            other = cell[0] + i, cell[1] + j
            inside = 0 <= other[0] < occupied.shape[0] and 0 <= other[1] < occupied.shape[1]
            new = cost + float(np.hypot(i, j))
            if inside and not occupied[other] and new < costs.get(other, np.inf):
                costs[other], before[other] = new, cell
                heapq.heappush(queue, (new, other))
    return []
