"""Where trajectories end: the marks of a dataset file, and what speaks against them."""

import re

import numpy as np

from metagcttt_core.data.errors import DatasetError
from metagcttt_core.data.values import chunks, flags

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
    for start, part in chunks(following[:-1]):
        stop = start + len(part)
        same = np.isclose(part, observations[start + 1 : stop + 1], rtol=1e-4, atol=1e-6)
        wrong = np.flatnonzero(~same.all(axis=1) & ~ends[start:stop])
        if len(wrong):
            row = start + int(wrong[0])
            raise DatasetError(
                f'{where}: {name} of row {row} is not observation {row + 1}, and no '
                'trajectory ends there: store rows in the order of time'
            )
