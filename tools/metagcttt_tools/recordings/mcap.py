"""Reading ROS messages from MCAP recordings, also from ones whose recorder was killed. No ROS."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
import struct
from typing import Any, cast, IO

from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk, StreamReader
from mcap.writer import MCAP0_MAGIC
from mcap_ros2.decoder import DecoderFactory
from metagcttt_core.data.bounds import check_announced, check_memory
from metagcttt_core.data.errors import DatasetError
import zstandard

from metagcttt_tools.common.unpacking import unpack

BACK_NS = 10**9
"""Messages that overtake others do so by less; a clock that was set back goes further."""

SILENCE_NS = 10 * 10**9
"""Nodes report their health every second: a longer silence is a clock set forward, or a break."""


@dataclass(frozen=True)
class Recorded:
    """One message of a recording.

    Attributes:
        topic: Its topic.
        type_name: Its type, such as `metagcttt_interfaces/msg/MazeState`.
        published_ns: When it was published, nanoseconds since 1970.
        message: The message, its fields as attributes.
        stretch: Number of the stretch of the file, between two jumps of a clock.
    """

    topic: str
    type_name: str
    published_ns: int
    message: Any
    stretch: int = 0


@dataclass(frozen=True)
class RecordedMessages:
    """The requested messages of one file.

    Attributes:
        messages: In the order of publication, stretch by stretch.
        topics: Topics of the file with their types, asked for or not.
        complete: Whether the file was finished; otherwise its end is missing.
        begin_ns: When its first message was logged, nanoseconds since 1970; 0 without one.
        end_ns: When its last message was logged.
        num_stretches: Stretches between jumps of a clock.
    """

    messages: list[Recorded]
    topics: dict[str, str]
    complete: bool
    begin_ns: int = 0
    end_ns: int = 0
    num_stretches: int = 1

    def goes_on_in(self, following: 'RecordedMessages') -> bool:
        """True if the next file may be the next part of the same recording, by its times."""
        return not jumps(self.end_ns, following.begin_ns)


def jumps(before_ns: int, after_ns: int) -> bool:
    """True if no clock goes from one time to the other between two messages of a recording."""
    return not -BACK_NS <= after_ns - before_ns <= SILENCE_NS


class Clocks:
    """Numbers the stretches of a file within which its clocks run on.

    A recorder appends messages as it receives them, and receives those of a topic about as they
    were published.
    """

    def __init__(self) -> None:
        """Start before the first message."""
        self.begin_ns = self.end_ns = 0
        self.num_stretches = 1
        self._published_ns: dict[int, int] = {}
        self._ahead_ns: dict[int, int] = {}

    def stretch(self, message: Message, *, wanted: bool) -> int:
        """The stretch of the next message; of unwanted ones only the time of logging counts."""
        self.begin_ns = self.begin_ns or message.log_time
        jump = bool(self.end_ns) and jumps(self.end_ns, message.log_time)
        self.end_ns = message.log_time
        if wanted:
            channel, published_ns = message.channel_id, message.publish_time
            # Behind the recorder's clock is a message that waited; ahead of it is another clock.
            ahead_ns = max(published_ns - message.log_time, 0)
            jump |= published_ns < self._published_ns.get(channel, 0) - BACK_NS
            jump |= ahead_ns > self._ahead_ns.get(channel, ahead_ns) + BACK_NS
        if jump:
            self._published_ns.clear()
            self._ahead_ns.clear()
        if wanted:
            self._published_ns[channel], self._ahead_ns[channel] = published_ns, ahead_ns
        self.num_stretches += jump
        return self.num_stretches - 1


class _File:
    """A file that says so when it ends within what is asked for."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def read(self, length: int) -> bytes:
        data = self._file.read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def _unpacked(record: McapRecord) -> list[McapRecord]:
    """The records in a chunk, which is unpacked only as far as it says; or the record itself.

    Raises:
        ValueError: See `unpack`.
    """
    if not isinstance(record, Chunk):
        return [record]
    data = unpack(record.data, record.compression, record.uncompressed_size)
    return breakup_chunk(replace(record, compression='', data=data), validate_crc=True)


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
    clocks = Clocks()
    decoded = 0
    try:
        with path.open('rb') as file:
            num_bytes = path.stat().st_size
            reader = StreamReader(
                cast('IO[bytes]', _File(file)),
                validate_crcs=True,
                emit_chunks=True,
                record_size_limit=max(num_bytes, 8),
            )
            for record in chain.from_iterable(map(_unpacked, reader.records)):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    schema = schemas.get(record.schema_id)
                    channels[record.id] = record
                    topics[record.topic] = schema.name if schema else ''
                    if schema and schema.name in type_names:
                        decoders[record.id] = factory.decoder_for(record.message_encoding, schema)
                elif isinstance(record, Message):
                    decode = decoders.get(record.channel_id)
                    stretch = clocks.stretch(record, wanted=decode is not None)
                    if decode is None:
                        continue
                    topic = channels[record.channel_id].topic
                    check_announced(decoded := decoded + len(record.data), num_bytes, 'it')
                    check_memory(4 * decoded, 'it')
                    content, published_ns = decode(record.data), record.publish_time
                    found.append(Recorded(topic, topics[topic], published_ns, content, stretch))
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
    found.sort(key=lambda recorded: (recorded.stretch, recorded.published_ns))
    return RecordedMessages(
        *(found, topics, complete), clocks.begin_ns, clocks.end_ns, clocks.num_stretches
    )
