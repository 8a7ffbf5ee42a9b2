"""Rows of a table as trajectories, by a column map."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from metagcttt_core.data import DatasetError, TrajectoryDataset
from metagcttt_core.data.inspection import TIME
import numpy as np
from numpy.typing import NDArray
import pyarrow as pa
import pyarrow.compute as pc

from metagcttt_tools.tables.columns import ColumnMap, CommandColumn, ObservedColumn
from metagcttt_tools.tables.files import numbers, read_csv, read_parquet

Names = Mapping[str, Sequence[str]]
"""The names of the values in columns of lists."""

_UNITS = {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}
_ROUNDING = 1e-6
_BEYOND = 1e-4


@dataclass(frozen=True)
class Value:
    """One observed or commanded value in all rows.

    Attributes:
        name: Its name.
        numbers: (N,), in units of the table.
        low: The lowest command, if there is one.
        high: The highest.
        reach: How far a command leads the measured value at most, if actions are such distances.
        measured: (N,) that value.
    """

    name: str
    numbers: NDArray[np.float64]
    low: float | None = None
    high: float | None = None
    reach: float | None = None
    measured: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Rows:
    """Rows in the order of time, with where trajectories end.

    Attributes:
        where: The file, for errors.
        observed: The values of the observation.
        commanded: The values of the action, in units of the table.
        ends: (N,) bool, true in the last row of each trajectory.
        times: (N,) seconds; None without a column of times.
    """

    where: str
    observed: list[Value]
    commanded: list[Value]
    ends: NDArray[np.bool_]
    times: NDArray[np.float64] | None


@dataclass(frozen=True)
class Found:
    """What was made of the rows.

    Attributes:
        dataset: The trajectories.
        single: Trajectories of a single row, which were left out.
        observed: The names of the observed values.
        commanded: The names of the values of an action.
        limits: By name, the commands that became -1 and 1.
        position: Which observed values are the position.
    """

    dataset: TrajectoryDataset
    single: int
    observed: list[str]
    commanded: list[str]
    limits: dict[str, tuple[float, float]]
    position: list[int]

    def in_words(self) -> list[str]:
        """What a user has to know, a line each."""
        lines = [
            f'  {name}: {low:g} to {high:g} became -1 to 1'
            for name, (low, high) in self.limits.items()
        ]
        if self.single:
            lines.append(f'  left out: {self.single} trajectories of a single row')
        if self.position:
            names = ', '.join(self.observed[dim] for dim in self.position)
            dims = ' '.join(map(str, self.position))
            lines.append(f'  position is {names}: --filter.position-dims {dims}')
        return lines


def read_tables(
    paths: Sequence[Path], columns: ColumnMap, *, limits_from_data: bool = False
) -> Found:
    """The trajectories of CSV and parquet files.

    Args:
        paths: The files; a trajectory never goes on in the next one.
        columns: What their columns are.
        limits_from_data: See `to_dataset`.

    Raises:
        DatasetError: If a file cannot be read, lacks a column, or holds what is no trajectory.
    """
    if columns.cut is None:
        raise DatasetError(
            'where do trajectories end? Give cut in the column map: episode, last, gap_s or file'
        )
    parts = [_read(path, columns) for path in paths]
    return to_dataset(parts, columns, limits_from_data=limits_from_data)


def _read(path: Path, columns: ColumnMap) -> Rows:
    assert columns.cut is not None
    optional = (columns.time, columns.cut.episode, columns.cut.last)
    wanted = [*columns.columns, *(name for name in optional if name)]
    if path.suffix == '.parquet':
        table = read_parquet(path, wanted)
    elif path.suffix == '.csv':
        table = read_csv(path, columns.delimiter, wanted)
    else:
        raise DatasetError(f'{path}: expected a .csv or a .parquet file')
    if not len(table):
        raise DatasetError(f'{path}: has no rows')
    times = _times(table, columns, str(path))
    return make_rows(table, columns, {}, _ends(table, columns, times, str(path)), times, str(path))


def make_rows(
    table: pa.Table,
    columns: ColumnMap,
    names: Names,
    ends: NDArray[np.bool_],
    times: NDArray[np.float64] | None,
    where: str,
) -> Rows:
    """The observed and commanded values of a table.

    Args:
        table: The table.
        columns: Which ones.
        names: The names of the values in its columns of lists, where they have some.
        ends: True in the last row of each trajectory.
        times: Times of the rows, seconds.
        where: The file, for errors.

    Raises:
        DatasetError: If a column holds no numbers or lacks a value, or times do not ascend.
    """
    if times is not None:
        back = np.flatnonzero((np.diff(times) <= 0) & ~ends[:-1])
        if len(back):
            row = int(back[0]) + 1
            raise DatasetError(
                f'{where}: the time is {times[row]:g} s in row {row}, after {times[row - 1]:g} s, '
                'and no trajectory ends between them'
            )
    found = [
        (name, content, each.origin)
        for each in columns.observations
        for name, content in _values(table, each, names, where)
    ]
    known = {name: content for name, content, _ in found}
    if unknown := [each.measured for each in columns.actions if each.measured not in {'', *known}]:
        raise DatasetError(
            f'{where}: no observed value is named {unknown[0]} (there are: {", ".join(known)})'
        )
    commanded = [
        Value(name, content, each.low, each.high, each.reach, known.get(each.measured))
        for each in columns.actions
        for name, content in _values(table, each, names, where)
    ]
    observed = [Value(name, content - origin) for name, content, origin in found]
    return Rows(where, observed, commanded, ends, times)


def to_dataset(
    parts: Sequence[Rows], columns: ColumnMap, *, limits_from_data: bool = False
) -> Found:
    """One dataset of all rows.

    Args:
        parts: The rows, by file.
        columns: What was read.
        limits_from_data: The lowest and highest commands of the data become -1 and 1 where the map
            gives no limits.

    Raises:
        DatasetError: If there is no transition, files differ, or an action is beyond its limits,
            which are -1 to 1 where none are given.
    """
    first = parts[0]
    observed = [value.name for value in first.observed]
    commanded = [value.name for value in first.commanded]
    for part in parts[1:]:
        if [value.name for value in (*part.observed, *part.commanded)] != observed + commanded:
            raise DatasetError(f'{part.where}: has other values than {first.where}')
    if unknown := [name for name in columns.position if name not in observed]:
        raise DatasetError(
            f'position: no observed value is named {unknown[0]} (there are: {", ".join(observed)})'
        )
    limits = _limits(parts, limits_from_data)
    # A trajectory of one row has no transition.
    kept = [~(part.ends & np.concatenate([[True], part.ends[:-1]])) for part in parts]
    if not any(keep.any() for keep in kept):
        raise DatasetError(f'{first.where}: no transitions, every trajectory is a single row')
    pairs = list(zip(parts, kept, strict=True))
    times = [part.times[keep] for part, keep in pairs if part.times is not None]
    dataset = TrajectoryDataset.from_arrays(
        np.vstack([np.stack([v.numbers for v in p.observed], axis=1)[keep] for p, keep in pairs]),
        np.vstack([_actions(part, limits)[keep] for part, keep in pairs]),
        np.concatenate([part.ends[keep] for part, keep in pairs]),
        {TIME: np.concatenate(times)} if len(times) == len(parts) else None,
        source=Path(first.where),
    )
    return Found(
        dataset,
        single=sum(int((~keep).sum()) for keep in kept),
        observed=observed,
        commanded=commanded,
        limits={
            value.name: pair
            for value, pair in zip(first.commanded, limits, strict=True)
            if pair and not value.reach
        },
        position=[observed.index(name) for name in columns.position],
    )


def _limits(parts: Sequence[Rows], limits_from_data: bool) -> list[tuple[float, float] | None]:
    found: list[tuple[float, float] | None] = []
    for number, value in enumerate(parts[0].commanded):
        if value.low is not None and value.high is not None:
            found.append((value.low, value.high))
        elif limits_from_data and not value.reach:
            content = np.concatenate([part.commanded[number].numbers for part in parts])
            low, high = float(content.min()), float(content.max())
            if not low < high:  # also for nan
                raise DatasetError(
                    f'{parts[0].where}: {value.name} is {low:g} to {high:g}, which are no limits'
                )
            found.append((low, high))
        else:
            found.append(None)
    return found


def _actions(part: Rows, limits: Sequence[tuple[float, float] | None]) -> NDArray[np.float64]:
    actions = []
    for value, pair in zip(part.commanded, limits, strict=True):
        if pair:
            _must_be_within(part.where, value.name, value.numbers, *pair)
        if value.reach is not None and value.measured is not None:
            ahead, reach = value.numbers - value.measured, value.reach
            _must_be_within(
                part.where, f'{value.name} less its measured value', ahead, -reach, reach
            )
            scaled = ahead / reach
        elif pair:
            scaled = 2 * (value.numbers - pair[0]) / (pair[1] - pair[0]) - 1
        else:
            hint = ': give low and high, or --limits-from-data'
            _must_be_within(part.where, value.name, value.numbers, -1.0, 1.0, _BEYOND, hint)
            scaled = value.numbers
        actions.append(np.clip(scaled, -1, 1))  # rounding
    return np.stack(actions, axis=1)


def _must_be_within(
    where: str,
    name: str,
    numbers: NDArray[np.float64],
    low: float,
    high: float,
    rounding: float = _ROUNDING,
    hint: str = '',
) -> None:
    slack = rounding * (high - low)
    beyond = np.flatnonzero((numbers < low - slack) | (numbers > high + slack))
    if len(beyond):
        row = beyond[0]
        raise DatasetError(
            f'{where}: {name} is {numbers[row]:g} in row {row}, beyond {low:g} to {high:g}{hint}'
        )


def _times(table: pa.Table, columns: ColumnMap, where: str) -> NDArray[np.float64] | None:
    if columns.time is None:
        return None
    unit = columns.time_unit
    if pa.types.is_timestamp(table.schema.field(columns.time).type):
        unit = 'ns'
        stamps = pc.cast(pc.cast(table[columns.time], pa.timestamp('ns')), pa.int64())
        table = pa.table({columns.time: stamps})
    ticks = numbers(table, columns.time, where)[:, 0]
    bad = np.flatnonzero(~np.isfinite(ticks))
    if len(bad):
        raise DatasetError(f'{where}: {columns.time} is {ticks[bad[0]]} in row {bad[0]}')
    # From the first on, so that nothing is lost of times since 1970.
    return (ticks - ticks[0]) * _UNITS[unit]


def _ends(
    table: pa.Table, columns: ColumnMap, times: NDArray[np.float64] | None, where: str
) -> NDArray[np.bool_]:
    cut = columns.cut
    assert cut is not None
    ends = np.arange(len(table)) == len(table) - 1
    if cut.episode:
        codes = table[cut.episode].combine_chunks().dictionary_encode().indices
        if codes.null_count:
            row = pc.index(pc.is_null(codes), True).as_py()
            raise DatasetError(f'{where}: {cut.episode} has no value in row {row}')
        ends[:-1] |= changes(codes.to_numpy(), cut.episode, where)
    if cut.last:
        flags = numbers(table, cut.last, where)[:, 0]
        wrong = np.flatnonzero((flags != 0) & (flags != 1))
        if len(wrong):
            raise DatasetError(
                f'{where}: {cut.last} must be true or false, 0 or 1, got {flags[wrong[0]]:g} in '
                f'row {wrong[0]}'
            )
        ends |= flags.astype(bool)
    if cut.gap_s is not None and times is not None:
        ends[:-1] |= np.diff(times) > cut.gap_s
    return ends


def changes(episodes: NDArray[np.integer], name: str, where: str) -> NDArray[np.bool_]:
    """Where the number of the trajectory changes, (N - 1,).

    Raises:
        DatasetError: If one comes again after another one.
    """
    changed = episodes[1:] != episodes[:-1]
    firsts = np.concatenate([[0], np.flatnonzero(changed) + 1])
    _, known = np.unique(episodes[firsts], return_index=True)
    again = np.setdiff1d(np.arange(len(firsts)), known)
    if len(again):
        raise DatasetError(
            f'{where}: the {name} of row {firsts[again[0]]} was there before, with another one in '
            'between: sort the rows by trajectory and time'
        )
    return changed


def _values(
    table: pa.Table, each: ObservedColumn | CommandColumn, names: Names, where: str
) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """The values of a column that are meant, with their names."""
    content = numbers(table, each.column, where)
    width = content.shape[1]
    known = list(names.get(each.column, ()))
    single = width == 1 and not known
    labels = known or ([each.column] if single else [f'{each.column}.{i}' for i in range(width)])
    for value in each.values or range(width):
        number = labels.index(value) if value in labels else value
        if not isinstance(number, int) or not 0 <= number < width:
            raise DatasetError(
                f'{where}: {each.column} has no value {value!r}; it has: {", ".join(labels)}'
            )
        yield labels[number], content[:, number]
