"""Where a function of states is highest along trajectories, without evaluating every state."""

from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np

RowValues = Callable[[np.ndarray], np.ndarray]

_STRIDE = 16
_HALVINGS = np.array([0, *((length - 1).bit_length() for length in range(1, _STRIDE + 1))])
_EXHAUSTIVE_ROWS = 16_384
_PROBES = 256
_SAFETY = 2.0


class _Gaps(NamedTuple):
    """Runs of rows of which both ends are evaluated and nothing between; (n,) each."""

    left: np.ndarray
    right: np.ndarray
    left_value: np.ndarray
    right_value: np.ndarray
    trajectory: np.ndarray
    probed: np.ndarray

    def take(self, which: np.ndarray) -> Self:
        return type(self)(*(array[which] for array in self))

    @classmethod
    def join(cls, *parts: Self) -> Self:
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def high_rows(
    value: RowValues, starts: np.ndarray, stops: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rows with the highest values of the `count` best trajectories among them.

    A function that is smooth along trajectories is evaluated at every 16th row, and gaps between
    evaluated rows are halved where they might hold a highest row, until there is none left. What
    a middle deviates from the line between its ends is kept by length; twice the largest of
    each, summed over the lengths to come, is how far a gap may exceed its ends. For that, 256
    gaps are halved to the end wherever they are. So a function that is not smooth is evaluated
    everywhere, as fewer than 16,384 rows always are. What this cannot see is a spike within a
    gap, twice as sharp as all that were met.

    Args:
        value: Of rows (n,), float32 (n,).
        starts: (m,) first row of each trajectory.
        stops: (m,) the row after its last, above `starts`.
        count: How many trajectories matter, by their highest value, and all that equal the last.

    Returns:
        (n,) rows, in no particular order, and their values.
    """
    if (stops - starts).sum() < _EXHAUSTIVE_ROWS:
        rows = ranges(starts, stops)
        return rows, value(rows)
    counts = 1 - (starts - stops + 1) // _STRIDE
    firsts = np.cumsum(counts) - counts
    trajectory = np.repeat(np.arange(len(starts)), counts)
    rows = starts[trajectory] + _STRIDE * (np.arange(len(trajectory)) - firsts[trajectory])
    rows = np.minimum(rows, stops[trajectory] - 1)
    values = value(rows)
    highest = np.maximum.reduceat(values, firsts)
    found_rows, found_values = [rows], [values]
    between = np.flatnonzero(trajectory[1:] == trajectory[:-1])
    probed = np.zeros(len(between), bool)
    probed[np.random.default_rng(0).permutation(len(between))[:_PROBES]] = True
    gaps = _Gaps(
        *(rows[between], rows[between + 1], values[between], values[between + 1]),
        *(trajectory[between], probed),
    )
    deviations = np.zeros(len(_HALVINGS))
    while True:
        halvings = _HALVINGS[gaps.right - gaps.left]
        bounds = np.maximum(gaps.left_value, gaps.right_value)
        bounds = bounds + _SAFETY * np.cumsum(deviations)[halvings]
        last = np.partition(highest, -count)[-count] if count < len(highest) else -np.inf
        needed = bounds >= np.maximum(highest, last)[gaps.trajectory]
        needed = (needed | gaps.probed) & (halvings > 0)
        if not needed.any():
            return np.concatenate(found_rows), np.concatenate(found_values)
        split, halvings = gaps.take(needed), halvings[needed]
        middle = (split.left + split.right) // 2
        values = value(middle)
        found_rows.append(middle)
        found_values.append(values)
        share = (middle - split.left) / (split.right - split.left)
        line = split.left_value + share * (split.right_value - split.left_value)
        np.maximum.at(deviations, halvings, np.abs(values - line))
        np.maximum.at(highest, split.trajectory, values)
        gaps = _Gaps.join(
            gaps.take(~needed),
            split._replace(right=middle, right_value=values),
            split._replace(left=middle, left_value=values),
        )


def ranges(starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """The rows of all [start, stop), in order."""
    counts = stops - starts
    if not len(counts):
        return np.empty(0, np.int64)
    offsets = np.repeat(starts - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
    return offsets + np.arange(counts.sum())
