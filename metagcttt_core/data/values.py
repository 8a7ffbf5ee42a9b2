"""The numbers of a dataset file, before anything is trained on them."""

from collections.abc import Iterator, Mapping
import logging

import numpy as np

from metagcttt_core.data.errors import DatasetError

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
    # Before narrowing: a finite double can become infinite in float32.
    usable(array, name, where)
    if array.dtype == np.float32:
        return array
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
    narrowed = array.astype(np.float32)
    lost = _lost_precision(array, narrowed)
    if not lost:
        return narrowed, origin
    for dim, _, _ in lost:
        column = array[:, dim]
        origin[dim] = np.rint(column.min() / 2 + column.max() / 2)
        _log.info('%s: %s[:, %d] is counted from %.0f', where, name, dim, origin[dim])
    return matrix(array - origin, name, where), origin


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
    for start, part in chunks(array):
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
    for start, part in chunks(array):
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


def warn_of_oddities(
    observations: np.ndarray, actions: np.ndarray, ends: np.ndarray, where: str
) -> None:
    """Log what can be trained on but is probably a mistake: large actions, and jumps."""
    largest = max(float(np.abs(part).max()) for _, part in chunks(actions))
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
    for start, part in chunks(observations):
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


def chunks(array: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """First row and content of parts small enough to be looked at in memory."""
    for start in range(0, len(array), _CHUNK_ROWS):
        yield start, array[start : start + _CHUNK_ROWS]


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
