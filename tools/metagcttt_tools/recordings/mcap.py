"""Reading ROS messages from MCAP recordings, also from ones whose recorder was killed. No ROS."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
import struct
from typing import Any, cast, IO

from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Footer, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from mcap_ros2.decoder import DecoderFactory
from metagcttt_core.data.errors import DatasetError
import zstandard


@dataclass(frozen=True)
class Recorded:
    """One message of a recording.

    Attributes:
        topic: Its topic.
        type_name: Its type, such as `metagcttt_interfaces/msg/MazeState`.
        published_ns: When it was published, nanoseconds since 1970.
        message: The message, its fields as attributes.
    """

    topic: str
    type_name: str
    published_ns: int
    message: Any


@dataclass(frozen=True)
class RecordedMessages:
    """The requested messages of one file.

    Attributes:
        messages: In the order of publication.
        topics: Topics of the file with their types, asked for or not.
        complete: Whether the file was finished; otherwise its end is missing.
    """

    messages: list[Recorded]
    topics: dict[str, str]
    complete: bool


class _File:
    """A file that says so when it ends within what is asked for."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def read(self, length: int) -> bytes:
        data = self._file.read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def read_messages(path: Path, type_names: Collection[str]) -> RecordedMessages:
    """All messages of some types, decoded.

    Args:
        path: An MCAP file with ROS 2 messages (schemas `ros2msg`, messages `cdr`), as written by
            recorder_node or `ros2 bag record`.
        type_names: The types, such as `metagcttt_interfaces/msg/MazeState`.

    Raises:
        DatasetError: If the file is missing, is no MCAP file, is damaged, or holds a message that
            does not fit its type. A file that merely ends early is no error.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    decoders: dict[int, Callable[[bytes], Any] | None] = {}
    factory = DecoderFactory()
    found: list[Recorded] = []
    topics: dict[str, str] = {}
    complete = False
    try:
        with path.open('rb') as file:
            reader = StreamReader(
                cast('IO[bytes]', _File(file)),
                validate_crcs=True,
                record_size_limit=max(path.stat().st_size, 8),
            )
            for record in reader.records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    schema = schemas.get(record.schema_id)
                    channels[record.id] = record
                    topics[record.topic] = schema.name if schema else ''
                    if schema and schema.name in type_names:
                        decoders[record.id] = factory.decoder_for(record.message_encoding, schema)
                elif isinstance(record, Message) and (decode := decoders.get(record.channel_id)):
                    topic = channels[record.channel_id].topic
                    content = decode(record.data)
                    found.append(Recorded(topic, topics[topic], record.publish_time, content))
                elif isinstance(record, Footer):
                    complete = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
                    break
    except (EndOfFile, RecordLengthLimitExceeded):
        pass  # the recorder was killed: all chunks before this one were read
    except FileNotFoundError as error:
        raise DatasetError(f'{path}: no such file') from error
    except OSError as error:
        raise DatasetError(f'{path}: cannot be read ({error})') from error
    except InvalidMagic as error:
        raise DatasetError(f'{path}: not an MCAP file') from error
    # The packages raise any of these for damaged records and messages, besides their own errors;
    # LZ4 raises RuntimeError.
    except (
        *(McapError, zstandard.ZstdError, RuntimeError, struct.error),
        *(ValueError, LookupError, OverflowError, MemoryError),
    ) as error:
        raise DatasetError(f'{path}: damaged ({error})') from error
    found.sort(key=lambda recorded: recorded.published_ns)
    return RecordedMessages(found, topics, complete)
