"""What is in a dataset, column by column, so that faults of sensors and logs are seen."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.errors import DatasetError

FAR_OUT = 3.0
"""Interquartile ranges beyond the quartiles from which Tukey calls a value far out."""
AT_LIMIT = 0.999
TIME = 'time_s'
"""The extra of a dataset with the times of its rows, seconds, ascending in a trajectory."""
_GAP = 1.5  # median steps


@dataclass(frozen=True)
class Column:
    """One column of observations or actions.

    Attributes:
        percentiles: The 0th, 1st, 50th, 99th and 100th.
        outliers: Values far out, more than three interquartile ranges beyond the quartiles.
        at_limit: Share of values of at least 0.999 in magnitude.
        repeated: Share of steps that change nothing, within trajectories.
        same_as: An earlier column with the same values that change; none when there is no such.
    """

    percentiles: tuple[float, ...]
    outliers: int
    at_limit: float
    repeated: float
    same_as: int | None

    @property
    def is_frozen(self) -> bool:
        """True when the value never changes."""
        return self.percentiles[0] == self.percentiles[-1]


@dataclass(frozen=True)
class Pace:
    """The time between rows, within trajectories.

    Attributes:
        rate_hz: Rows a second, by the median step.
        steps_s: The 1st, 50th and 99th percentile of the steps, seconds.
        gaps: Steps of more than one and a half times the median.
        longest_s: The longest step, seconds.
        longest_row: The row that it follows.
    """

    rate_hz: float
    steps_s: tuple[float, ...]
    gaps: int
    longest_s: float
    longest_row: int


@dataclass(frozen=True)
class Inspection:
    """What is in a dataset.

    Attributes:
        lengths: Transitions of each trajectory.
        observations: Their columns.
        actions: Their columns, without the last rows of trajectories, whose actions are not taken.
        repeated_rows: Transitions that leave the whole observation as it is.
        pace: Rate and gaps; none for data without times.
    """

    lengths: NDArray[np.int64]
    observations: list[Column]
    actions: list[Column]
    repeated_rows: int
    pace: Pace | None


def inspect(dataset: TrajectoryDataset) -> Inspection:
    """The columns and trajectories of a dataset.

    Raises:
        DatasetError: If it has no transitions.
    """
    steps = np.flatnonzero(~dataset.terminals)
    if not len(steps):
        raise DatasetError(f'{dataset.source or "dataset"}: no transitions')
    following = steps + 1
    observations = np.asarray(dataset.states(slice(None)))
    # The last action of a trajectory is stored, but never taken.
    within = steps[~dataset.terminals[following]]
    return Inspection(
        lengths=dataset.episode_ends - dataset.episode_starts,
        observations=_columns(observations, steps, following),
        actions=_columns(np.asarray(dataset.actions)[steps], *_positions(steps, within)),
        repeated_rows=int((observations[steps] == observations[following]).all(axis=1).sum()),
        pace=_pace(dataset.extras[TIME], steps) if TIME in dataset.extras else None,
    )


def _pace(times: np.ndarray, steps: NDArray[np.int64]) -> Pace:
    seconds = times[steps + 1] - times[steps]
    low, median, high = np.percentile(seconds, (1, 50, 99)).tolist()
    longest = int(seconds.argmax())
    return Pace(
        rate_hz=1 / median if median > 0 else float('nan'),
        steps_s=(low, median, high),
        gaps=int((seconds > _GAP * median).sum()),
        longest_s=float(seconds[longest]),
        longest_row=int(steps[longest]),
    )


def _positions(
    steps: NDArray[np.int64], within: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows `within` a trajectory and those after them, as positions among `steps`."""
    found = np.searchsorted(steps, within)
    return found, found + 1


def _columns(
    table: np.ndarray, before: NDArray[np.int64], after: NDArray[np.int64]
) -> list[Column]:
    return [_column(table, number, before, after) for number in range(table.shape[1])]


def _column(
    table: np.ndarray, number: int, before: NDArray[np.int64], after: NDArray[np.int64]
) -> Column:
    values = table[:, number]
    low, high = np.percentile(values, (25, 75))
    reach = FAR_OUT * (high - low)
    same = (i for i in range(number) if np.array_equal(table[:, i], values) and np.ptp(values))
    return Column(
        percentiles=tuple(np.percentile(values, (0, 1, 50, 99, 100)).tolist()),
        outliers=int(((values < low - reach) | (values > high + reach)).sum()),
        at_limit=float((np.abs(values) >= AT_LIMIT).mean()),
        repeated=float((values[before] == values[after]).mean()) if len(before) else 0.0,
        same_as=next(same, None),
    )
