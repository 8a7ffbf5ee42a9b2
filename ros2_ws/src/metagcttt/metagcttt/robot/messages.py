"""Messages, their definitions and qualities of service as a contract names them."""

from collections.abc import Mapping
from importlib import import_module
import re
from typing import Any

from metagcttt_core.robot.topics import Qos
from metagcttt_core.robot.types import FieldType
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

_ARRAY = re.compile(r'sequence<([^,>]+)(?:, \d+)?>|(.+)\[\d+\]')


def message_class(type_name: str) -> Any:
    """The class of a type such as `nav_msgs/msg/Odometry`.

    Raises:
        LookupError: If its package is not installed or has no such message.
    """
    package, _, name = type_name.split('/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except (ModuleNotFoundError, AttributeError) as error:
        raise LookupError(f'not installed here: {error}') from error


def definitions(type_name: str) -> Mapping[str, FieldType]:
    """The fields of a message type by name; raises LookupError for one that is not installed."""
    fields = message_class(type_name).get_fields_and_field_types()
    return {name: _field_type(text) for name, text in fields.items()}


def profile(qos: Qos) -> QoSProfile:
    """A contract's quality of service."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=qos.depth,
        reliability=ReliabilityPolicy[qos.reliability.upper()],
        durability=DurabilityPolicy[qos.durability.upper()],
    )


def _field_type(text: str) -> FieldType:
    array = _ARRAY.fullmatch(text)
    name = (array[1] or array[2]) if array else text
    return FieldType(name.replace('/', '/msg/'), is_array=array is not None)
