"""Reading and writing npz files of arrays, without ever unpickling."""

from collections.abc import Mapping, Sequence
import os
from pathlib import Path
import shutil
import tempfile
from tokenize import TokenError
from typing import IO
import zipfile
import zlib

import numpy as np

from metagcttt_core.data.errors import DatasetError
from metagcttt_core.files import atomic_write

MEMORY_MAP_BYTES = 2 << 30
"""Files that unpack to more than this many bytes are memory-mapped by default."""


def read_arrays(
    path: Path, required: Sequence[str], memory_map: bool | None = None
) -> dict[str, np.ndarray]:
    """Every array of an npz file by name.

    Args:
        path: The file.
        required: Names that must be there.
        memory_map: Map the arrays from disk instead of reading them; by default only large files.
            The archive is unpacked once into the folder `NAME.unpacked` beside it.

    Raises:
        DatasetError: If the file is missing, not an npz file, truncated, pickled, or lacks a name.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix('.npy'): info for info in archive.infolist()}
            for name in members:
                if Path(name).name != name:  # would escape the folder
                    raise DatasetError(f'{path}: {name!r} is not a plain array name')
            missing = [name for name in required if name not in members]
            if missing:
                raise DatasetError(
                    f'{path}: missing {", ".join(missing)}; '
                    f'required: {", ".join(required)}; found: {", ".join(members)}'
                )
            if memory_map is None:
                memory_map = sum(info.file_size for info in members.values()) > MEMORY_MAP_BYTES
            if memory_map:
                folder = _unpack(path, archive, members)
                return {name: _read(path, name, folder / f'{name}.npy') for name in members}
            return {name: _read(path, name, archive.open(info)) for name, info in members.items()}
    except FileNotFoundError as error:
        raise DatasetError(f'{path}: no such file') from error
    except IsADirectoryError as error:
        raise DatasetError(f'{path}: is a folder, expected an npz file') from error
    except DatasetError:
        raise
    except OSError as error:
        raise DatasetError(f'{path}: cannot be read or unpacked ({error})') from error
    # What zipfile raises for damaged, encrypted or unknown archives, besides its own error.
    except (zipfile.BadZipFile, RuntimeError, ValueError) as error:
        raise DatasetError(f'{path}: not a complete npz file ({error})') from error


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a compressed npz file; `path` holds the old content or the new, never a part."""
    with atomic_write(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _read(path: Path, name: str, source: Path | IO[bytes]) -> np.ndarray:
    """One array: mapped when `source` is a path, read when it is an open member of the archive."""
    try:
        if isinstance(source, Path):
            return np.load(source, mmap_mode='r', allow_pickle=False)
        with source:
            return np.lib.format.read_array(source, allow_pickle=False)
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise DatasetError(f'{path}: {name} is truncated or damaged ({error})') from error
    except MemoryError as error:
        raise DatasetError(f'{path}: {name} does not fit into memory ({error})') from error
    except (ValueError, OverflowError, TokenError) as error:  # a bad header leads to any of these
        raise DatasetError(
            f'{path}: {name} cannot be read, it is pickled or damaged ({error})'
        ) from error


def _unpack(path: Path, archive: zipfile.ZipFile, members: Mapping[str, zipfile.ZipInfo]) -> Path:
    """The archive's arrays as npy files beside it, renewed when the archive changed."""
    stat = path.stat()
    folder = path.with_name(f'{path.stem}.unpacked') / f'{stat.st_size:x}-{stat.st_mtime_ns:x}'
    folder.mkdir(parents=True, exist_ok=True)
    for name, info in members.items():
        target = folder / f'{name}.npy'
        if target.exists() and target.stat().st_size == info.file_size:
            continue
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            try:
                extracted = archive.extract(info, scratch)
            except (zipfile.BadZipFile, zlib.error, EOFError) as error:
                raise DatasetError(f'{path}: {name} is truncated or damaged ({error})') from error
            os.replace(extracted, target)
    for outdated in folder.parent.iterdir():
        if outdated != folder:
            shutil.rmtree(outdated)
    return folder
