"""Checks of what a dataset file says, before anything is trained on it."""

from collections.abc import Iterator, Mapping
import logging
import re

import numpy as np

from metagcttt_core.data.errors import DatasetError

ROWS = ('observations', 'actions')
"""Arrays that every dataset has, beside its marks."""

END_MARKS = (
    'timeouts',
    'truncations',
    'truncated',
    'terminations',
    'terminated',
    'dones',
    'episode_ends',
)
"""Arrays that mark the last rows of trajectories, beside `terminals`."""

_LIKE_A_MARK = re.compile(r'timeout|trunc|termin|done|episode|traj|first|last|start|end|reset')
_LIKE_A_MARK_OF_ROWS = re.compile(
    r'(?<![a-z])(masks?|discounts?|(time)?steps?|segments?|rollouts?|valids|boundary|boundaries|'
    r'final|finished|eps|demos?|runs?|ids?|idx|index|cont|continues?|continuations?|absorbing|'
    r'gammas?|seeds?|workers?|envs?|elapsed)(?![a-z])'
)
_LIKE_TIME = re.compile(r'(?<![a-z])(t|times?|(time)?stamps?|clock|seconds|secs|ns)(?![a-z])')
_LIKE_BOUNDS = re.compile(r'length|lens|size|offset|split|bound|cut|begin')
_OBSERVED = r'(obs?|observations?|states?)'
_FOLLOWING = re.compile(
    rf'(next|new|following|successor)_{_OBSERVED}|{_OBSERVED}_?(next|new|prime|tp1|t1|2)'
)
_CHUNK_ROWS = 1 << 20
_JUMP = 30.0  # times the longest of ordinary steps
_LARGEST = 1e15  # far beyond any unit; squares of it are finite in single precision
_FAR = 1e3  # nearer to zero, single precision is finer than any measurement in metres
_SMALL = 1e-3  # of an action's range, -1 to 1
_log = logging.getLogger(__name__)


def matrix(values: np.ndarray, name: str, where: str) -> np.ndarray:
    """`values` as float32 of shape (rows, dimensions).

    Raises:
        DatasetError: If they are no real numbers of that shape, or not finite, beyond 1e15, or
            masked.
    """
    array = unmasked(values, name, where)
    if array.dtype.kind not in 'fiu':
        raise DatasetError(f'{where}: {name} must hold real numbers, got dtype {array.dtype}')
    if array.ndim != 2 or array.shape[1] == 0:
        raise DatasetError(
            f'{where}: {name} must have shape (rows, dimensions), got {array.shape}'
        )
    if array.dtype == np.float32:
        usable(array, name, where)
        return array
    # Checked before narrowing too: a finite double can become infinite in float32.
    usable(array, name, where)
    narrowed = array.astype(np.float32)
    _warn_of_lost_precision(array, narrowed, name, where)
    return narrowed


def centred(values: np.ndarray, name: str, where: str) -> tuple[np.ndarray, np.ndarray]:
    """`values` as float32 counted from an origin, and the origin (dimensions,) float64.

    The origin is the middle of the range, in whole units, where the numbers are so far from zero
    that float32 would round their changes away; elsewhere it is zero.

    Raises:
        DatasetError: As `matrix`.
    """
    array = unmasked(values, name, where)
    if not _is_finer(array) or array.ndim != 2 or len(array) < 2 or array.shape[1] == 0:
        plain = matrix(array, name, where)
        _warn_of_coarse_numbers(plain, name, where)
        return plain, np.zeros(plain.shape[1])
    usable(array, name, where)
    origin = np.zeros(array.shape[1])
    dims = [dim for dim, _, _ in _lost_precision(array, array.astype(np.float32))]
    for dim in dims:
        column = array[:, dim]
        origin[dim] = np.rint(column.min() / 2 + column.max() / 2)
        _log.info('%s: %s[:, %d] is counted from %.0f', where, name, dim, origin[dim])
    return matrix(array - origin if dims else array, name, where), origin


def flags(values: np.ndarray, name: str, where: str) -> np.ndarray:
    """`values` as booleans of shape (rows,).

    Raises:
        DatasetError: If they are neither booleans nor zeros and ones of that shape.
    """
    array = np.asanyarray(values)
    if array.ndim != 1:
        raise DatasetError(f'{where}: {name} must have shape (rows,), got {array.shape}')
    if array.dtype == np.bool_:
        return array
    if array.dtype.kind not in 'fiu':
        raise DatasetError(
            f'{where}: {name} must hold booleans or 0 and 1, got dtype {array.dtype}'
        )
    wrong = np.flatnonzero((array != 0) & (array != 1))
    if len(wrong):
        raise DatasetError(
            f'{where}: {name} must hold 0 or 1, got {array[wrong[0]]} in row {wrong[0]}'
        )
    return array.astype(bool)


def finite(array: np.ndarray, name: str, where: str) -> None:
    """Refuse numbers that are not finite.

    Raises:
        DatasetError: With the row of the first.
    """
    if found := _not_finite(array):
        row, value = found
        raise DatasetError(f'{where}: {name} is {value} in row {row}; every value must be finite')


def without_gaps(extras: Mapping[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    """The arrays of a file that nothing needs, but for those with nan or inf, which are logged."""
    found = {name: _not_finite(array) for name, array in extras.items()}
    for name, place in found.items():
        if place:
            _log.warning('%s: %s is left out, it is %s in row %d', where, name, place[1], place[0])
    return {name: array for name, array in extras.items() if not found[name]}


def _not_finite(array: np.ndarray) -> tuple[int, float] | None:
    """Row and value of the first number that is not finite."""
    if array.dtype.kind != 'f':
        return None
    for start, part in _chunks(array):
        good = np.isfinite(part).reshape(len(part), -1)
        if not good.all():
            row = int(np.flatnonzero(~good.all(axis=1))[0])
            return start + row, part[row].reshape(-1)[~good[row]][0]
    return None


def usable(array: np.ndarray, name: str, where: str) -> None:
    """Refuse numbers that are not finite, or so large that computing with them gives none.

    Raises:
        DatasetError: With the row of the first.
    """
    for start, part in _chunks(array):
        if -_LARGEST <= float(part.min()) and float(part.max()) <= _LARGEST:  # not with nan
            continue
        finite(array, name, where)
        large = np.abs(part) > _LARGEST
        row = int(np.flatnonzero(large.any(axis=1))[0])
        raise DatasetError(
            f'{where}: {name} is {part[row][large[row]][0]:.3g} in row {start + row}; every '
            f'value must be within {_LARGEST:g}'
        )


def unmasked(values: np.ndarray, name: str, where: str) -> np.ndarray:
    """`values` as a plain array.

    Raises:
        DatasetError: If some are masked, with the row of the first.
    """
    array = np.asanyarray(values)
    if not isinstance(array, np.ma.MaskedArray):
        return array
    if np.ma.is_masked(array):
        row = int(np.argwhere(np.ma.getmaskarray(array))[0][0])
        raise DatasetError(f'{where}: {name} is masked in row {row}; every value must be there')
    return np.asarray(array)


def looks_like_a_mark(name: str, *, of_rows: bool = False) -> bool:
    """True for the name of an array that may say where trajectories end.

    Args:
        name: The name.
        of_rows: The array has a value for each row: then numbers of episodes and steps, too.
    """
    words = _words(name)
    return bool(_LIKE_A_MARK.search(words) or (of_rows and _LIKE_A_MARK_OF_ROWS.search(words)))


def looks_like_time(name: str) -> bool:
    """True for the name of an array that may say when each row was."""
    return bool(_LIKE_TIME.search(_words(name)))


def _words(name: str) -> str:
    return re.sub(r'(?<=[a-z])(?=[A-Z])', '_', name).lower()


def is_following(name: str) -> bool:
    """True for the name of the observations after each row."""
    return bool(_FOLLOWING.fullmatch(name.lower()))


def divides_rows(name: str, values: np.ndarray, rows: int) -> bool:
    """True for whole numbers that divide the rows: lengths of trajectories, or their bounds.

    Args:
        name: Of the array.
        values: An array that has no value for each row.
        rows: How many rows there are.
    """
    if not may_divide_rows(values.shape, values.dtype, rows):
        return False
    if (values > 0).all() and int(values.sum()) == rows:
        return True
    rises = bool((values[1:] > values[:-1]).all()) and values[0] >= 0 and values[-1] <= rows
    return rises and bool(values[-1] >= rows - 1 or _LIKE_BOUNDS.search(_words(name)))


def may_divide_rows(shape: tuple[int, ...], dtype: np.dtype, rows: int) -> bool:
    """True for the shape and type of what `divides_rows` has to look at."""
    return len(shape) == 1 and dtype.kind in 'iu' and 1 < shape[0] < rows


def take_ends(arrays: dict[str, np.ndarray], where: str) -> np.ndarray:
    """The rows that end a trajectory, by `terminals` and all `END_MARKS`, which are taken out.

    Counts of steps and their kin are taken out where they tell of no other ends.

    Raises:
        DatasetError: If a mark is no flag for each row, or another array looks like a mark.
    """
    ends = flags(arrays.pop('terminals'), 'terminals', where)
    for name in [name for name in END_MARKS if name in arrays]:
        mark = flags(arrays.pop(name), name, where)
        if len(mark) != len(ends):
            raise DatasetError(
                f'{where}: {name} has {len(mark)} rows but terminals has {len(ends)}'
            )
        ends = ends | mark
    for name in [name for name in arrays if looks_like_a_mark(name, of_rows=True)]:
        if _is_table(arrays[name], len(ends)):
            continue
        if _tells_more(arrays.pop(name), ends) or looks_like_a_mark(name):
            raise DatasetError(
                f'{where}: {name} looks like a mark of trajectories and is not understood: remove '
                f'it, or give it one of the names {", ".join(END_MARKS)} (true on last rows)'
            )
    for name in [name for name in arrays if len(arrays[name]) != len(ends)]:
        if name in ROWS or is_following(name):
            continue
        values = arrays.pop(name)
        if divides_rows(name, values, len(ends)) and not _divides_at(values, ends):
            raise DatasetError(
                f'{where}: {name} divides the rows at other places than the marks of ends: mark '
                f'ends by {", ".join(END_MARKS)} (true on last rows), or remove {name}'
            )
    for name, array in arrays.items():
        row = _starts_again(name, array, ends)
        if row is not None:
            raise DatasetError(
                f'{where}: {name} starts again after row {row}, where no trajectory ends: mark '
                f'ends by {", ".join(END_MARKS)} (true on last rows), or remove {name}'
            )
    return ends


def _divides_at(values: np.ndarray, ends: np.ndarray) -> bool:
    """Whether lengths or bounds of trajectories are those of the marked ends."""
    bounds = np.concatenate([[0], np.flatnonzero(ends) + 1])
    return np.array_equal(values, np.diff(bounds)) or bool(
        any(np.isin(values + shift, bounds).all() for shift in (0, 1))
        and len(values) >= len(bounds) - 2
    )


def _starts_again(name: str, array: np.ndarray, ends: np.ndarray) -> int | None:
    """The row after which time, or what rises like it, begins again inside a trajectory."""
    if array.shape not in (ends.shape, (*ends.shape, 1)) or array.dtype.kind not in 'fiu':
        return None
    values = array.reshape(-1)
    falls = (values[1:] < values[:-1]) & ~ends[:-1]
    if not falls.any():
        return None
    is_count = (values[1:][falls] == values[0]).all() and (values[1:] > values[:-1])[~falls].all()
    is_count = bool(is_count) and bool(falls.sum() < len(falls) / 3)
    return int(falls.argmax()) if is_count or looks_like_time(name) else None


def _is_table(array: np.ndarray, rows: int) -> bool:
    """True for several numbers a row, which are no mark."""
    return array.ndim > 1 and len(array) == rows and array.size > rows


def _tells_more(mark: np.ndarray, ends: np.ndarray) -> bool:
    """Whether a mark changes inside a trajectory, other than by equal steps.

    The first and the last row of a trajectory may differ from those between.
    """
    if mark.size != len(ends) or len(mark) != len(ends):
        return True
    edges = ends.copy()
    edges[1:] |= ends[:-1]
    edges[0] = True
    inside = ~(edges[:-1] | edges[1:])
    values = mark.reshape(-1)
    if values.dtype.kind in 'bfiu':
        steps = np.diff(values.astype(np.float64))[inside]
        return bool(len(steps)) and not (steps == steps[0]).all()  # nan is unequal, too
    return bool((values[1:] != values[:-1])[inside].any())


def following_rows(
    observations: np.ndarray, following: np.ndarray, ends: np.ndarray, name: str, where: str
) -> None:
    """Refuse `next_observations`, by whatever name, that are not those of the next row.

    Raises:
        DatasetError: With the first row of a transition that leads somewhere else.
    """
    if following.dtype.kind not in 'fiu':
        raise DatasetError(f'{where}: {name} must hold real numbers, got dtype {following.dtype}')
    if following.shape != observations.shape:
        raise DatasetError(
            f'{where}: {name} has shape {following.shape}, observations has '
            f'{observations.shape}; they must match'
        )
    for start, part in _chunks(following[:-1]):
        stop = start + len(part)
        same = np.isclose(part, observations[start + 1 : stop + 1], rtol=1e-4, atol=1e-6)
        wrong = np.flatnonzero(~same.all(axis=1) & ~ends[start:stop])
        if len(wrong):
            row = start + int(wrong[0])
            raise DatasetError(
                f'{where}: {name} of row {row} is not observation {row + 1}, and no '
                'trajectory ends there: store rows in the order of time'
            )


def warn_of_oddities(
    observations: np.ndarray, actions: np.ndarray, ends: np.ndarray, where: str
) -> None:
    """Log what can be trained on but is probably a mistake: large actions, and jumps."""
    largest = max(float(np.abs(part).max()) for _, part in _chunks(actions))
    if largest > 1 + 1e-4:
        _log.warning(
            '%s: actions reach %.3g, beyond -1 to 1: pre-training scales them by the largest',
            where,
            largest,
        )
    elif 0 < largest < _SMALL:
        _log.warning(
            '%s: actions reach only %.3g of the range -1 to 1, too little to be learnt well: '
            'scale them to it',
            where,
            largest,
        )
    longest, row, ordinary = 0.0, 0, 0.0
    for start, part in _chunks(observations):
        inside = ~ends[start : start + len(part) - 1]
        steps = np.abs(np.diff(part[:, :2], axis=0)).max(axis=1) * inside
        if len(steps) and steps.max() > longest:
            longest, row = float(steps.max()), start + int(steps.argmax())
        if (moved := steps[steps > 0]).size:
            ordinary = max(ordinary, float(np.quantile(moved, 0.9, method='lower')))
    if ordinary and longest > _JUMP * ordinary:
        _log.warning(
            '%s: from row %d to the next the first two numbers jump by %.3g, where 90 %% of the '
            'steps are below %.3g: does a trajectory end there?',
            where,
            row,
            longest,
            ordinary,
        )


def _warn_of_lost_precision(
    exact: np.ndarray, narrowed: np.ndarray, name: str, where: str
) -> None:
    """Log numbers so far from zero that float32 rounds their changes away."""
    for dim, lost, step in _lost_precision(exact, narrowed):
        _log.warning(
            '%s: %s[:, %d] loses %.2g in float32, where a step is %.2g: subtract an origin',
            where,
            name,
            dim,
            lost,
            step,
        )


def _lost_precision(exact: np.ndarray, narrowed: np.ndarray) -> list[tuple[int, float, float]]:
    """The dimensions that lose more than a twentieth of a step, with loss and usual step."""
    if not _is_finer(exact) or len(exact) < 2:
        return []
    part = exact[:_CHUNK_ROWS].astype(np.float64)
    lost = np.abs(part - narrowed[:_CHUNK_ROWS]).max(axis=0)
    steps = _usual_steps(part)
    dims = np.flatnonzero((lost > 0.05 * steps) & (steps > 0) & np.isfinite(lost))
    return [(int(dim), float(lost[dim]), float(steps[dim])) for dim in dims]


def _usual_steps(part: np.ndarray) -> np.ndarray:
    """The median change from row to row of each dimension; far from zero, of rows that moved."""
    changes = np.abs(np.diff(part, axis=0))
    steps = np.median(changes, axis=0)
    for dim in np.flatnonzero((steps == 0) & (np.abs(part).max(axis=0) > _FAR)):
        if (moved := changes[changes[:, dim] > 0, dim]).size:
            steps[dim] = np.median(moved)
    return steps


def _is_finer(array: np.ndarray) -> bool:
    """True for types that hold numbers which float32 rounds."""
    return array.dtype.kind in 'iu' or (array.dtype.kind == 'f' and array.dtype.itemsize > 4)


def _warn_of_coarse_numbers(array: np.ndarray, name: str, where: str) -> None:
    """Log numbers that were stored in single precision and have been rounded by it."""
    part = array[:_CHUNK_ROWS]
    if len(part) < 2 or not (far := np.abs(part).max(axis=0) > _FAR).any():
        return
    spacing = np.spacing(np.abs(part).max(axis=0))
    steps = _usual_steps(part)
    for dim in np.flatnonzero((spacing > 0.05 * steps) & (steps > 0) & far):
        _log.warning(
            '%s: %s[:, %d] is stored in steps of %.2g, where it moves by %.2g: store it in double '
            'precision, or subtract an origin before',
            where,
            name,
            dim,
            spacing[dim],
            steps[dim],
        )


def _chunks(array: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """First row and content of parts small enough to be looked at in memory."""
    for start in range(0, len(array), _CHUNK_ROWS):
        yield start, array[start : start + _CHUNK_ROWS]
