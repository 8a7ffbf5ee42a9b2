"""Fields of a contract compared with the definitions of its message types."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from metagcttt_core.robot.contract import Contract
from metagcttt_core.robot.topics import CommandTopic, CommandValue, Numbers, ObservedTopic

_NUMBERS = frozenset(
    ['float', 'double', 'float32', 'float64']
    + [f'{sign}int{bits}' for sign in ('', 'u') for bits in (8, 16, 32, 64)]
)


class FieldType(NamedTuple):
    """Type of a field: a primitive or a message such as `geometry_msgs/msg/Pose`."""

    name: str
    is_array: bool = False


Definitions = Callable[[str], Mapping[str, FieldType]]
"""The fields of a message type by name; raises LookupError for a type that is not known."""


def type_faults(contract: Contract, definitions: Definitions) -> list[str]:
    """What of a contract its message types do not have; empty when all is there.

    Args:
        contract: The contract.
        definitions: Where the message types are defined: ROS, or a bag.
    """
    return [
        f'{topic.topic}: {fault}'
        for topic in contract.topics
        for fault in _faults(topic, definitions)
    ]


def has_header(type_name: str, definitions: Definitions) -> bool:
    """True for types whose messages carry a time and a frame."""
    return definitions(type_name).get('header') == FieldType('std_msgs/msg/Header')


def _faults(topic: ObservedTopic | CommandTopic, definitions: Definitions) -> Iterator[str]:
    try:
        fields = definitions(topic.type)
    except LookupError as error:
        yield f'type {topic.type} is not known ({error})'
        return
    if not has_header(topic.type, definitions):
        if isinstance(topic, ObservedTopic) and topic.stamp == 'header':
            yield f'stamp header: {topic.type} has no header; use receive'
        if topic.frame_id:
            yield f'frame_id: {topic.type} has no header'
    for value in topic.values:
        found = _find(value.field, topic.type, definitions)
        if isinstance(found, str):
            yield found
        elif fault := _unsuitable(value, found):
            yield f'{value.field}: {fault}'
        elif value.joints and isinstance(topic, ObservedTopic) and 'name' not in fields:
            yield f'{value.field}: {topic.type} has no names of joints; use size'


def _find(path: str, type_name: str, definitions: Definitions) -> FieldType | str:
    """The type of a field below a message type, or why there is none."""
    found = FieldType(type_name)
    for part in path.split('.'):
        fields = {} if found.is_array or '/' not in found.name else definitions(found.name)
        if part not in fields:
            accepted = f' (there are: {", ".join(fields)})' if fields else ''
            return f'{path}: {found.name} has no field {part}{accepted}'
        found = fields[part]
    return found


def _unsuitable(value: Numbers, found: FieldType) -> str:
    if getattr(value, 'transform', 'none') == 'heading':
        is_rotation = found == FieldType('geometry_msgs/msg/Quaternion')
        return '' if is_rotation else f'a heading is read of a quaternion, this is {found.name}'
    if found.name not in _NUMBERS:
        return f'{found.name} is no number'
    if isinstance(value, CommandValue) and 'int' in found.name:
        return f'commands are floating-point numbers, this is {found.name}'
    if found.is_array and not value.joints and value.size is None:
        return 'an array takes joints or size'
    if not found.is_array and (value.joints or value.size is not None):
        return 'one number has no joints and no size'
    return ''
