"""MCAP files and bag folders of serialized ROS messages, for standard tools."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from itertools import count
import os
from pathlib import Path
import re
from typing import Any, cast, IO

from ament_index_python.packages import get_package_share_directory
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import Writer
from rclpy.qos import QoSProfile
import yaml

from metagcttt.recorder.bag_metadata import bag_metadata, NAME, qos_as_yaml, Span, Topic

_MESSAGE = re.compile(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)')
_FEEDBACK = re.compile(r'([a-z][a-z0-9_]*)/action/([A-Z][A-Za-z0-9]*)_FeedbackMessage')
_OTHER_BAGS = ('.bag', '.db3', '.yaml')
_SEPARATOR = '=' * 80 + '\n'
_BUILTIN = frozenset(
    'bool byte char float32 float64 int8 uint8 int16 uint16 int32 uint32 int64 uint64 '
    'string wstring'.split()
)


class UnknownTypeError(LookupError):
    """A message type that is not installed."""


def message_class(type_name: str) -> Any:
    """The class of a type such as `nav_msgs/msg/Path` or `.../action/NAME_FeedbackMessage`.

    Raises:
        UnknownTypeError: If it is no message type or its package is not installed.
    """
    try:
        if match := _MESSAGE.fullmatch(type_name):
            return getattr(import_module(f'{match[1]}.msg'), match[2])
        if match := _FEEDBACK.fullmatch(type_name):
            return getattr(import_module(f'{match[1]}.action'), match[2]).Impl.FeedbackMessage
    except (ModuleNotFoundError, AttributeError) as error:
        raise UnknownTypeError(f'{type_name} is not installed here ({error})') from error
    raise UnknownTypeError(f'{type_name} is not a message type')


def message_definition(type_name: str) -> str:
    """The `ros2msg` schema of a message type: its definition and those of all types in it.

    Raises:
        UnknownTypeError: If a definition is not installed.
    """
    parts = {}
    if feedback := _FEEDBACK.fullmatch(type_name):
        package, action = feedback.groups()
        # What rosidl makes of the third part of an action's definition.
        inner = f'{package}/action/{action}_Feedback'
        text = f'unique_identifier_msgs/UUID goal_id\n{inner} feedback\n'
        parts[inner] = _definition_file(package, 'action', action).split('\n---\n')[-1]
    else:
        text = _message_definition(type_name)
    seen = {type_name}
    waiting = list(_types_in(type_name, text))
    while waiting:
        name = waiting.pop(0)
        if name in seen:
            continue
        seen.add(name)
        part = parts.get(name) or _message_definition(name)
        waiting += _types_in(name, part)
        text += f'\n{_SEPARATOR}MSG: {name.replace("/msg/", "/")}\n{part}'
    return text


def _message_definition(type_name: str) -> str:
    package, kind, name = type_name.split('/')
    return _definition_file(package, kind, name)


def _definition_file(package: str, kind: str, name: str) -> str:
    """The definition of a message (kind `msg`) or an action (`action`)."""
    try:
        file = Path(get_package_share_directory(package)) / kind / f'{name}.{kind}'
        return file.read_text(encoding='utf-8')
    except (LookupError, OSError) as error:
        reason = f'{package}/{kind}/{name}: its definition is missing ({error})'
        raise UnknownTypeError(reason) from error


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
        if base.count('/') == 2:
            yield base
        else:
            owner, _, name = base.rpartition('/')
            yield f'{owner or package}/msg/{name}'


class _WholeRecords:
    """A file in which a write is whole or not at all, so that it stays readable on a full disk."""

    def __init__(self, path: Path) -> None:
        """Create the file, which must not exist."""
        self._file = path.open('xb', buffering=0)
        self.tell = self._file.tell
        self.close = self._file.close

    def write(self, data: bytes) -> None:
        """Append records."""
        begin, left = self._file.tell(), memoryview(data)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            self._file.seek(begin)
            self._file.truncate()
            raise

    def flush(self) -> None:
        """Nothing is kept back."""


class Recording:
    """A recording: one MCAP file or, with a size limit, consecutive files, or a bag folder.

    A folder is what `ros2 bag record` makes: NAME/NAME_0.mcap and so on, and metadata.yaml. If the
    process is killed, a recording is readable up to the last `flush`. Nothing that exists is
    overwritten. Where a file cannot be written, as on a full disk, it is readable up to there, and
    the next file begins as soon as it can.

    Attributes:
        paths: The files so far.
        num_lost: Messages that came while nothing could be written.
    """

    def __init__(self, path: Path, *, split_bytes: int = 0) -> None:
        """Create the first file.

        Args:
            path: A name that ends in .mcap: the file; later ones are NAME_1.mcap, NAME_2.mcap
                and so on beside it. Otherwise a folder.
            split_bytes: Size at which the next file starts; 0: never.

        Raises:
            OSError: If the file or folder exists or cannot be written.
            ValueError: If the name is that of another kind of bag.
        """
        if path.suffix in _OTHER_BAGS:
            raise ValueError(f'{path}: bags are written as .mcap, or as a folder with that')
        self._folder = None if path.suffix == '.mcap' else path
        self._first = path if self._folder is None else path / f'{path.name}_0.mcap'
        self._split_bytes = split_bytes
        self._topics: dict[str, Topic] = {}
        self._spans: dict[str, Span] = {}
        self._all = Span()
        self.paths: list[Path] = []
        self.num_lost = 0
        self._is_broken = False
        path.parent.mkdir(parents=True, exist_ok=True)
        if self._folder is not None:
            self._folder.mkdir()
        self._open(self._first)

    @property
    def num_messages(self) -> int:
        """Number of messages so far."""
        return self._all.count

    def add_topic(
        self,
        topic: str,
        type_name: str,
        offered: Sequence[QoSProfile] = (),
        type_hash: str = '',
    ) -> None:
        """Register a topic before its first message.

        Args:
            topic: The topic.
            type_name: Its type.
            offered: The qualities of service of its publishers, for those who play it.
            type_hash: The hash of its type, if known.

        Raises:
            UnknownTypeError: If the definition of its type is not installed.
        """
        entry = Topic(type_name, offered, type_hash)
        if not self._is_broken:
            self._register(topic, entry)
        self._topics.setdefault(topic, entry)

    def add(self, topic: str, data: bytes, *, log_time: int, publish_time: int) -> None:
        """Append one message.

        Args:
            topic: Its topic, registered with `add_topic`.
            data: The message, serialized as CDR.
            log_time: Time of reception by the system clock, nanoseconds since 1970.
            publish_time: Time of publication by the system clock, nanoseconds since 1970. Neither
                is the stamp of a header, which may be simulated time.

        Raises:
            OSError: If it cannot be written. From then on, messages are lost until a `flush` is
                able to begin the next file.
        """
        if self._is_broken:
            self.num_lost += 1
            return
        with self._watched():
            self._append(topic, data, log_time, publish_time)

    def _append(self, topic: str, data: bytes, log_time: int, publish_time: int) -> None:
        if self._split_bytes and self._file.tell() >= self._split_bytes:
            self._close_file()
            self._open(self._next())
        self._writer.add_message(
            self._channels[topic],
            log_time=log_time,
            data=data,
            publish_time=publish_time,
            sequence=self.num_messages & 0xFFFFFFFF,
        )
        self._topics[topic].count += 1
        for span in (self._all, self._spans[self.paths[-1].name]):
            span.add(log_time)

    def flush(self) -> None:
        """Pass everything so far to the operating system, where it survives a kill.

        Raises:
            OSError: If it cannot be written.
        """
        with self._watched():
            if self._is_broken:
                self._open(self._next())
                self._is_broken = False
            self._writer.flush()
            self._write_metadata()

    def close(self) -> None:
        """Write the index and close the file.

        Raises:
            OSError: If it cannot be written.
        """
        with self._watched():
            if not self._is_broken:
                self._close_file()
            self._write_metadata()

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Leaves the file as it is, for good, when something cannot be written."""
        try:
            yield
        except OSError:
            self._file.close()
            self._is_broken = True
            raise

    def _next(self) -> Path:
        """The file after the last one: of the next number that is free."""
        stem = self._first.stem.removesuffix('_0') if self._folder else self._first.stem
        names = (self._first.with_stem(f'{stem}_{number}') for number in count(len(self.paths)))
        return next(path for path in names if not os.path.lexists(path))

    def _close_file(self) -> None:
        self._writer.finish()
        self._file.close()

    def _write_metadata(self) -> None:
        if self._folder is not None:
            text = bag_metadata(self._spans, self._all, self._topics)
            new = self._folder / f'.{NAME}.new'
            new.write_text(text, encoding='utf-8')
            new.replace(self._folder / NAME)

    def _open(self, path: Path) -> None:
        self._file = _WholeRecords(path)
        self._writer = Writer(cast('IO[bytes]', self._file))
        self.paths.append(path)
        self._spans[path.name] = Span()
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        try:
            self._writer.start(profile=Profile.ROS2, library='metagcttt')
            for topic, entry in self._topics.items():
                self._register(topic, entry)
            self._write_metadata()
        except OSError:  # it holds no message yet
            self.paths.remove(path)
            del self._spans[path.name]
            path.unlink()
            raise

    def _register(self, topic: str, entry: Topic) -> None:
        if entry.type_name not in self._schemas:
            text = message_definition(entry.type_name)
            self._schemas[entry.type_name] = self._writer.register_schema(
                entry.type_name, SchemaEncoding.ROS2, text.encode()
            )
        if topic not in self._channels:
            # As rosbag2 keeps them, for those who play the file without its folder.
            offered = yaml.safe_dump([qos_as_yaml(profile) for profile in entry.offered])
            self._channels[topic] = self._writer.register_channel(
                topic,
                MessageEncoding.CDR,
                self._schemas[entry.type_name],
                {'offered_qos_profiles': offered, 'topic_type_hash': entry.type_hash},
            )
