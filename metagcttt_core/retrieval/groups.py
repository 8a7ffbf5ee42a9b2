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
    keys = values.astype(np.float64)  # of one type with `smallest`, else numpy casts one by one
    smallest = np.full(episodes.max() + 1, np.inf)
    np.minimum.at(smallest, episodes, keys)
    hits = np.flatnonzero(keys == smallest[episodes])
    hits = hits[np.argsort(rows[hits])]  # few: one per trajectory, and ties
    firsts = hits[np.flatnonzero(np.diff(episodes[hits], prepend=-1))]
    return Best(episodes[firsts], rows[firsts], values[firsts])
