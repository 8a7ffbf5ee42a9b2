"""Unpacking of compressed parts of recordings: no further than they say, or than is sensible."""

from functools import partial
import shutil
import tempfile
from types import SimpleNamespace, TracebackType
from typing import IO, Self

import lz4.frame
from metagcttt_core.data import DatasetError
from rosbags.rosbag2 import reader, storage_mcap
import zstandard

LARGEST_PART = 256 << 20
"""Bytes of a chunk or of a message that are unpacked; recorders write some megabytes."""


def unpack(data: bytes, compression: str, size: int) -> bytes:
    """Unpack a chunk, whose header says how large it is.

    Args:
        data: What is stored.
        compression: `zstd`, `lz4` or empty.
        size: What the header announces, bytes.

    Raises:
        ValueError: If it is larger than any recorder makes them, or not as large as it says.
    """
    if size > LARGEST_PART:
        raise ValueError(f'a chunk announces {size} bytes, at most {LARGEST_PART} are read')
    if compression == 'zstd':
        data = _unpack_zstd(data, size)
    elif compression == 'lz4':
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    if len(data) != size:
        raise ValueError(f'a chunk does not unpack to {size} bytes, as it says')
    return data


def _unpack_zstd(data: bytes, most: int) -> bytes:
    """Up to one byte more than `most`."""
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
        return stream.read(most + 1)


def _unpack_message(data: bytes) -> bytes:
    message = _unpack_zstd(data, LARGEST_PART)
    if len(message) > LARGEST_PART:
        raise ValueError(f'a message unpacks to more than {LARGEST_PART} bytes')
    return message


def _unpack_chunk(compression: str, data: bytes, size: int) -> bytes:
    return unpack(data, compression, size)


class _UnpackedFile:
    """A compressed file of a bag, which is unpacked into a temporary one."""

    def __init__(self, file: IO[bytes], mode: str) -> None:
        self._stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
        self._left = self._most = shutil.disk_usage(tempfile.gettempdir()).free // 2

    def read(self, size: int) -> bytes:
        data = self._stream.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise DatasetError(
                f'a file of it unpacks to more than {self._most} bytes, half of what is free in '
                f'{tempfile.gettempdir()}'
            )
        return data

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stream.close()


def bound_rosbags() -> None:
    """Have rosbags unpack within these bounds; its own functions make gigabytes of kilobytes."""
    for compression in storage_mcap.DECOMPRESSORS:
        storage_mcap.DECOMPRESSORS[compression] = partial(_unpack_chunk, compression)
    bounded = SimpleNamespace(decompress=_unpack_message, open=_UnpackedFile)
    setattr(reader, 'zstd', bounded)  # noqa: B010 - which it does not export
