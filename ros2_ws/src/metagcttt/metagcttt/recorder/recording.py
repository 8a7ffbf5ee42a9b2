"""MCAP files of serialized ROS messages, for standard tools."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
import re
from typing import Any

from ament_index_python.packages import get_package_share_directory
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import Writer

_TYPE = re.compile(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)')
_SEPARATOR = '=' * 80 + '\n'
_BUILTIN = frozenset(
    'bool byte char float32 float64 int8 uint8 int16 uint16 int32 uint32 int64 uint64 '
    'string wstring'.split()
)


class UnknownTypeError(LookupError):
    """A message type that is not installed."""


def message_class(type_name: str) -> Any:
    """The class of a type such as `nav_msgs/msg/Path`.

    Raises:
        UnknownTypeError: If it is no message type or its package is not installed.
    """
    match = _TYPE.fullmatch(type_name)
    if match is None:
        raise UnknownTypeError(f'{type_name} is not a message type')
    try:
        return getattr(import_module(f'{match[1]}.msg'), match[2])
    except (ModuleNotFoundError, AttributeError) as error:
        raise UnknownTypeError(f'{type_name} is not installed here ({error})') from error


def message_definition(type_name: str) -> str:
    """The `ros2msg` schema of a message type: its definition and those of all types in it.

    Raises:
        UnknownTypeError: If a definition is not installed.
    """
    text = _definition_file(type_name)
    seen = {type_name}
    waiting = list(_types_in(type_name, text))
    while waiting:
        name = waiting.pop(0)
        if name in seen:
            continue
        seen.add(name)
        part = _definition_file(name)
        waiting += _types_in(name, part)
        text += f'\n{_SEPARATOR}MSG: {name.replace("/msg/", "/")}\n{part}'
    return text


def _definition_file(type_name: str) -> str:
    package, _, name = type_name.split('/')
    try:
        file = Path(get_package_share_directory(package)) / 'msg' / f'{name}.msg'
        return file.read_text(encoding='utf-8')
    except (LookupError, OSError) as error:
        raise UnknownTypeError(f'{type_name}: its definition is missing ({error})') from error


def _types_in(type_name: str, text: str) -> Iterator[str]:
    """The message types of the fields of a definition."""
    package = type_name.split('/')[0]
    for line in text.splitlines():
        words = line.split('#')[0].split()
        if len(words) < 2:
            continue
        base = re.split(r'\[|<', words[0])[0]
        if base in _BUILTIN:
            continue
        owner, _, name = base.rpartition('/')
        yield f'{owner.removesuffix("/msg") or package}/msg/{name}'


class Recording:
    """A recording in one MCAP file or, with a size limit, in consecutive files.

    If the process is killed, a file is readable up to the last `flush`. An existing file is never
    overwritten.
    """

    def __init__(self, path: Path, *, split_bytes: int = 0) -> None:
        """Create the first file.

        Args:
            path: The file; later ones are NAME_1.mcap, NAME_2.mcap and so on beside it.
            split_bytes: Size at which the next file starts; 0: never.

        Raises:
            OSError: If the file exists or cannot be written.
        """
        self._first = path
        self._split_bytes = split_bytes
        self._types: dict[str, str] = {}
        self.paths: list[Path] = []
        self.num_messages = 0
        path.parent.mkdir(parents=True, exist_ok=True)
        self._open(path)

    def add_topic(self, topic: str, type_name: str) -> None:
        """Register a topic before its first message.

        Raises:
            UnknownTypeError: If the definition of its type is not installed.
        """
        self._register(topic, type_name)
        self._types[topic] = type_name

    def add(self, topic: str, data: bytes, *, log_time: int, publish_time: int) -> None:
        """Append one message.

        Args:
            topic: Its topic, registered with `add_topic`.
            data: The message, serialized as CDR.
            log_time: Time of reception, nanoseconds since 1970.
            publish_time: Time of publication, nanoseconds since 1970.
        """
        if self._split_bytes and self._file.tell() >= self._split_bytes:
            self.close()
            self._open(self._first.with_stem(f'{self._first.stem}_{len(self.paths)}'))
        self._writer.add_message(
            self._channels[topic],
            log_time=log_time,
            data=data,
            publish_time=publish_time,
            sequence=self.num_messages & 0xFFFFFFFF,
        )
        self.num_messages += 1

    def flush(self) -> None:
        """Pass everything so far to the operating system, where it survives a kill."""
        self._writer.flush()

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()
        self._file.close()

    def _open(self, path: Path) -> None:
        self._file = path.open('xb')
        self.paths.append(path)
        self._writer = Writer(self._file)
        self._writer.start(profile=Profile.ROS2, library='metagcttt')
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        for topic, type_name in self._types.items():
            self._register(topic, type_name)

    def _register(self, topic: str, type_name: str) -> None:
        if type_name not in self._schemas:
            text = message_definition(type_name)
            self._schemas[type_name] = self._writer.register_schema(
                type_name, SchemaEncoding.ROS2, text.encode()
            )
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic, MessageEncoding.CDR, self._schemas[type_name]
            )
