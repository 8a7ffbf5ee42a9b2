"""Reading and writing npz files of arrays, without ever unpickling."""

from collections.abc import Mapping, Sequence
import hashlib
import io
import json
import logging
import math
import os
from pathlib import Path
import shutil
import tempfile
from tokenize import TokenError
from typing import Any, IO, NamedTuple
import zipfile
import zlib

import numpy as np

from metagcttt_core.data.bounds import check_announced, check_memory
from metagcttt_core.data.errors import DatasetError
from metagcttt_core.data.marks import is_following, looks_like_a_mark, may_divide_rows
from metagcttt_core.files import atomic_write, claim_folder

MEMORY_MAP_BYTES = 2 << 30
"""Files that unpack to more than this many bytes are memory-mapped by default."""

_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError)
_BAD_HEADER = (ValueError, OverflowError, TokenError)
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_LARGEST_HEADER = 12 + 10000  # NumPy reads no larger ones, but would unpack them first
_LARGEST_TEXT = 16 << 20
_log = logging.getLogger(__name__)


class _Member(NamedTuple):
    """An array in the archive, known by its header alone."""

    info: zipfile.ZipInfo
    shape: tuple[int, ...]
    dtype: np.dtype


def read_arrays(
    path: Path, required: Sequence[str], memory_map: bool | None = None
) -> dict[str, np.ndarray]:
    """The arrays of rows in an npz file by name: those required, and others of equal length.

    Whatever else the file holds is left out without being read: texts, single numbers, arrays of
    other lengths, Python objects, files that are no arrays. Only what looks like a mark of
    trajectories is never left out.

    Args:
        path: The file.
        required: Names that must be there. The first decides the number of rows.
        memory_map: Map the arrays from disk instead of reading them; by default only large files.
            The archive is unpacked once into the folder `NAME.unpacked` beside it.

    Raises:
        DatasetError: If the file is missing, not an npz file, truncated, pickled, or lacks a name.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = _chosen(path, archive, required)
            num_bytes = sum(member.info.file_size for member in members.values())
            if memory_map or (memory_map is None and num_bytes > MEMORY_MAP_BYTES):
                folder = _unpack(path, archive, members)
                return {name: _read(path, name, folder / f'{name}.npy') for name in members}
            check_memory(num_bytes, str(path))
            return {name: _read(path, name, archive.open(m.info)) for name, m in members.items()}
    except FileNotFoundError as error:
        raise DatasetError(f'{path}: no such file') from error
    except IsADirectoryError as error:
        raise DatasetError(f'{path}: is a folder, expected an npz file') from error
    except DatasetError:
        raise
    except OSError as error:
        raise DatasetError(f'{path}: cannot be read or unpacked ({error})') from error
    # zipfile raises these for damaged, encrypted or unknown archives, besides its own error.
    except (zipfile.BadZipFile, RuntimeError, ValueError) as error:
        raise DatasetError(f'{path}: not a complete npz file ({error})') from error


def read_json(path: Path, name: str) -> dict[str, Any] | None:
    """The object that a text in an npz file holds as JSON; None where there is no such text.

    Raises:
        DatasetError: If the text is no JSON object.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if f'{name}.npy' not in archive.namelist():
                return None
            text = _header(path, name, archive, archive.getinfo(f'{name}.npy'))
            if text.shape or text.dtype.kind != 'U' or text.dtype.itemsize > _LARGEST_TEXT:
                raise ValueError(f'{text.dtype} of shape {text.shape}, no short text')
            content = json.loads(_read(path, name, archive.open(text.info)).item())
        if not isinstance(content, dict):
            raise ValueError(f'a {type(content).__name__}, no object')
    except (*_DAMAGE, *_BAD_HEADER, OSError, MemoryError, RecursionError) as error:
        raise DatasetError(f'{path}: {name} is no JSON object ({error})') from error
    return content


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a compressed npz file; `path` holds the old content or the new, never a part."""
    with atomic_write(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _chosen(path: Path, archive: zipfile.ZipFile, required: Sequence[str]) -> dict[str, _Member]:
    """The members worth reading, by name of the array."""
    infos = {i.filename[:-4]: i for i in archive.infolist() if i.filename.endswith('.npy')}
    for name in infos:
        if Path(name).name != name:  # would escape the folder
            raise DatasetError(f'{path}: {name!r} is not a plain array name')
    missing = [name for name in required if name not in infos]
    if missing:
        raise DatasetError(
            f'{path}: missing {", ".join(missing)}; '
            f'required: {", ".join(required)}; found: {", ".join(infos)}'
        )
    members = {name: _header(path, name, archive, info) for name, info in infos.items()}
    rows = members[required[0]].shape[:1] if required else None
    chosen = {
        name: member
        for name, member in members.items()
        if name in required
        or rows is None
        or (member.shape[:1] == rows and member.dtype.kind in 'bfiu')
        or (member.shape and looks_like_a_mark(name, of_rows=member.shape[:1] == rows))
        or (member.shape[:1] == rows and is_following(name))
        or (rows and may_divide_rows(member.shape, member.dtype, rows[0]))
    }
    if left_out := sorted(members.keys() - chosen.keys()):
        _log.info('%s: left out %s, which are no rows of numbers', path, ', '.join(left_out))
    return chosen


def _header(path: Path, name: str, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> _Member:
    """Shape and type of an array, after checking that as many bytes follow as they need."""
    if info.compress_type not in _METHODS:
        raise DatasetError(f'{path}: {name} is compressed by another method than deflate')
    stored = min(info.compress_size, path.stat().st_size)
    check_announced(info.file_size, stored, f'{path}: {name}')
    try:
        with archive.open(info) as file:
            head = io.BytesIO(file.read(_LARGEST_HEADER))
        version = np.lib.format.read_magic(head)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(head)
        else:
            shape, _, dtype = np.lib.format.read_array_header_2_0(head)
        num_bytes = info.file_size - head.tell()
    except _DAMAGE as error:
        raise DatasetError(f'{path}: {name} is truncated or damaged ({error})') from error
    except (*_BAD_HEADER, MemoryError, RecursionError) as error:
        raise DatasetError(
            f'{path}: {name} cannot be read, it is pickled or damaged ({error})'
        ) from error
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize != num_bytes:
        raise DatasetError(
            f'{path}: {name} is damaged: {dtype} of shape {shape} does not take {num_bytes} bytes'
        )
    return _Member(info, shape, dtype)


def _read(path: Path, name: str, source: Path | IO[bytes]) -> np.ndarray:
    """One array: mapped when `source` is a path, read when it is an open member of the archive."""
    try:
        if isinstance(source, Path):
            return np.load(source, mmap_mode='r', allow_pickle=False)
        with source:
            return np.lib.format.read_array(source, allow_pickle=False)
    except _DAMAGE as error:
        raise DatasetError(f'{path}: {name} is truncated or damaged ({error})') from error
    except MemoryError as error:
        raise DatasetError(f'{path}: {name} does not fit into memory ({error})') from error
    except _BAD_HEADER as error:
        raise DatasetError(
            f'{path}: {name} cannot be read, it is pickled or damaged ({error})'
        ) from error


def _unpack(path: Path, archive: zipfile.ZipFile, members: Mapping[str, _Member]) -> Path:
    """The archive's arrays as npy files beside it, renewed when the archive changed."""
    content = [(name, m.info.CRC, m.info.file_size) for name, m in sorted(members.items())]
    unpacked = path.with_name(f'{path.stem}.unpacked')
    claim_folder(unpacked)
    # By content: a file may change in place and keep its size and time.
    folder = unpacked / hashlib.sha256(repr(content).encode()).hexdigest()[:16]
    folder.mkdir(exist_ok=True)
    missing = {
        name: member
        for name, member in members.items()
        if not _is_unpacked(folder / f'{name}.npy', member)
    }
    num_bytes = sum(member.info.file_size for member in missing.values())
    free = shutil.disk_usage(folder).free
    if num_bytes > free:
        raise DatasetError(f'{path}: unpacks to {num_bytes} bytes beside it, {free} are free')
    for name, member in missing.items():
        target = folder / f'{name}.npy'
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            try:
                extracted = archive.extract(member.info, scratch)
            except _DAMAGE as error:
                raise DatasetError(f'{path}: {name} is truncated or damaged ({error})') from error
            os.replace(extracted, target)
    for outdated in unpacked.iterdir():
        if outdated.is_dir() and not outdated.is_symlink() and outdated != folder:
            shutil.rmtree(outdated)
    return folder


def _is_unpacked(target: Path, member: _Member) -> bool:
    return target.exists() and target.stat().st_size == member.info.file_size
