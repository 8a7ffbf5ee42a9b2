"""Reductions over runs of rows that belong to the same trajectory."""

from typing import NamedTuple

import numpy as np


class Best(NamedTuple):
    """One row for each trajectory that has any."""

    episodes: np.ndarray
    rows: np.ndarray
    values: np.ndarray


def smallest_per_episode(episodes: np.ndarray, rows: np.ndarray, values: np.ndarray) -> Best:
    """The row of the smallest value in each trajectory, the first on ties.

    Args:
        episodes: (n,) trajectory of each row.
        rows: (n,) rows, in any order.
        values: (n,) what to minimise.

    Returns:
        Trajectories in ascending order.
    """
    if not len(rows):
        return Best(episodes, rows, values)
    order = np.argsort(rows)
    episodes, rows, values = episodes[order], rows[order], values[order]
    starts = np.flatnonzero(np.diff(episodes, prepend=-1))
    smallest = np.minimum.reduceat(values, starts)
    counts = np.diff(np.append(starts, len(rows)))
    hits = np.flatnonzero(values == np.repeat(smallest, counts))
    firsts = hits[np.searchsorted(hits, starts)]
    return Best(episodes[starts], rows[firsts], smallest)
