"""Numbers read from and written to fields of messages, by their names alone.

The messages may be those of rclpy or of a bag reader: only their attributes are used.
"""

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from metagcttt_core.robot.errors import MessageError
from metagcttt_core.robot.topics import Numbers, ObservedValue

_UNIT_TOLERANCE = 1e-2
_LARGEST = float(np.finfo(np.float32).max)


def read_numbers(value: Numbers, message: Any) -> NDArray[np.float64]:
    """The numbers of a field, shape (num_values,), in the order of the contract.

    Raises:
        MessageError: If the field, a joint or a number is missing, or a number is not finite.
    """
    try:
        content = attrgetter(value.field)(message)
    except AttributeError as error:
        raise MessageError(f'no field {value.field} ({error})') from error
    if value.joints:
        found = _of_joints(value, content, getattr(message, 'name', None))
    else:
        found = np.atleast_1d(np.asarray(content, dtype=np.float64))
        if found.shape != (value.num_values,):
            raise MessageError(f'{value.field} has {found.size} values, not {value.num_values}')
    return _finite(value.field, found)


def observe(value: ObservedValue, message: Any) -> NDArray[np.float64]:
    """The part of the observation that a message holds, one number for each of `columns`.

    Raises:
        MessageError: As `read_numbers`, or for a quaternion that is not of unit length, or a
            number that single precision cannot hold.
    """
    if value.transform == 'heading':
        return _heading(value.field, message)
    found = transformed(value, read_numbers(value, message))
    if (np.abs(found) > _LARGEST).any():
        raise MessageError(f'{value.field} is beyond single precision: {found.tolist()}')
    return found


def transformed(value: ObservedValue, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """The observed values of numbers in units of the message."""
    found = (numbers - value.origin) * value.scale
    if value.transform == 'angle':
        return np.concatenate([np.cos(found), np.sin(found)])
    if value.transform == 'wrap':
        return np.arctan2(np.sin(found), np.cos(found))
    return found if value.clamp is None else np.clip(found, *value.clamp)


def write_numbers(value: Numbers, message: Any, numbers: ArrayLike) -> None:
    """Put numbers into a field, with the names of joints where the message takes names."""
    parent, _, name = value.field.rpartition('.')
    target = attrgetter(parent)(message) if parent else message
    listed = np.asarray(numbers, dtype=np.float64).tolist()
    setattr(target, name, listed if value.joints or value.size is not None else listed[0])
    if value.joints and hasattr(message, 'name'):
        message.name = list(value.joints)


def _of_joints(
    value: Numbers, content: Sequence[float], names: Sequence[str] | None
) -> NDArray[np.float64]:
    order = list(value.joints) if names is None else list(names)
    if len(content) != len(order):
        raise MessageError(f'{value.field} has {len(content)} values for {len(order)} joints')
    if missing := [joint for joint in value.joints if joint not in order]:
        raise MessageError(f'no joint {", ".join(missing)} (there are: {", ".join(order)})')
    if doubled := [joint for joint in value.joints if order.count(joint) > 1]:
        raise MessageError(f'joint {", ".join(doubled)} more than once')
    return np.array([content[order.index(joint)] for joint in value.joints], dtype=np.float64)


def _heading(field: str, message: Any) -> NDArray[np.float64]:
    try:
        q = attrgetter(field)(message)
        parts = (q.x, q.y, q.z, q.w)
    except AttributeError as error:
        raise MessageError(f'no quaternion {field} ({error})') from error
    try:
        return heading(*parts)
    except MessageError as error:
        raise MessageError(f'{field} {error}') from error


def heading(x: float, y: float, z: float, w: float) -> NDArray[np.float64]:
    """Cosine and sine of the angle by which a quaternion turns the x axis around z.

    Raises:
        MessageError: If it is not finite, not of unit length, or has no heading.
    """
    q = np.array([x, y, z, w], dtype=np.float64)
    if not np.isfinite(q).all():
        raise MessageError(f'is not finite: {q.tolist()}')
    length = float(q @ q)
    if abs(length - 1.0) > _UNIT_TOLERANCE:
        raise MessageError(f'is no rotation: its length is {np.sqrt(length):g}, not 1')
    x, y, z, w = q
    turned = np.array([1.0 - 2.0 * (y * y + z * z) / length, 2.0 * (w * z + x * y) / length])
    flat = np.hypot(*turned)
    if flat < _UNIT_TOLERANCE:
        raise MessageError('points straight up or down and has no heading')
    return turned / flat


def _finite(field: str, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    if not np.isfinite(numbers).all():
        raise MessageError(f'{field} is not finite: {numbers.tolist()}')
    return numbers
