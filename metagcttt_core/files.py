"""Files and folders that are safe to write and to remove.

Writes are atomic: a crash leaves the old content or the new, never a part. A folder is removed
only if it carries our mark, results replace only results of ours, and no link is followed, so
nothing that somebody else made is ever deleted.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
import hashlib
import json
import os
from pathlib import Path
import platform
import re
import shutil
import tempfile
import time
from typing import Any, IO, TypeVar

PICTURE_MARK = 'metagcttt'
"""The text in a PNG or GIF by which it is known as ours."""

WEIGHTS = r'weights-[0-9a-f]{16}\.safetensors'
"""Names of files of weights: by the hash of their content."""

_T = TypeVar('_T')
_MARK = '.made-by-metagcttt'
_LOG_MARK = re.compile(rb'# \d{4}-\d\d-\d\d \d\d:\d\d:\d\d on .*: metagcttt ')
_LONGEST_MARK = 500
_PICTURES = ('.png', '.gif')
_PROVENANCE = {'commit', 'versions'}


@contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """A binary file that replaces `path` when the block ends without an error.

    Missing folders are created. On any failure, `path` keeps its old content.

    Raises:
        FileExistsError: If `path` is a symbolic link, a folder, a pipe or a device: to replace it
            would be to lose it.
        OSError: If it cannot be written; names it, also where the disk is full.
    """
    if path.is_symlink():
        raise FileExistsError(f'{path} is a symbolic link: move it elsewhere')
    if path.exists() and not path.is_file():
        raise FileExistsError(f'{path} exists and is no file: choose another place')
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(descriptor, 'wb') as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(FileNotFoundError):
            os.unlink(temporary)
        if isinstance(error, OSError) and error.errno and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def write_text(path: Path, text: str) -> None:
    """Write text atomically."""
    with atomic_write(path) as file:
        file.write(text.encode())


def in_words(error: OSError) -> str:
    """The file and what is wrong with it, for a person to read."""
    if error.filename is None or error.strerror is None:
        return str(error)
    reason = 'is no folder' if isinstance(error, FileExistsError) else error.strerror.lower()
    return f'{error.filename}: {reason}'


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON atomically, one key per line."""
    with atomic_write(path) as file:
        file.write((json.dumps(content, indent=2) + '\n').encode())


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it holds anything else; names the file.
    """
    return _object(path, path.read_bytes())


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON objects in a file, one a line; a last one cut short by a crash is left out.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it holds anything else; names file and line.
    """
    *lines, _ = path.read_bytes().split(b'\n')
    return [_object(f'{path}:{number}', line) for number, line in enumerate(lines, 1)]


def _object(place: Path | str, text: bytes) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f'{place}: not valid JSON ({error})') from error
    if not isinstance(content, dict):
        raise ValueError(f'{place}: must hold a JSON object, got {type(content).__name__}')
    return content


def not_through_links(path: str, flags: int) -> int:
    """An `opener` for `open` that refuses a symbolic link."""
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def weights_name(content: bytes) -> str:
    """The name of a file of weights."""
    return f'weights-{hashlib.sha256(content).hexdigest()[:16]}.safetensors'


def write_with_weights(index: Path, content: Mapping[str, Any], weights: bytes) -> None:
    """Write a file of weights and the JSON file beside it that names them, as one.

    The index is replaced last: a crash in between leaves the previous pair whole. Then weights
    that no index names any more are removed, and what a writer left that was killed; links, and
    files whose content is not that of their name, are somebody else's and stay.

    Args:
        index: The JSON file.
        content: What it holds; names the weights by `weights_name`.
        weights: The content of the file of weights.

    Raises:
        OSError: If one cannot be written. The previous pair is still there.
    """
    name = weights_name(weights)
    with atomic_write(index.parent / name) as file:
        file.write(weights)
    write_json(index, content)
    part = re.compile(rf'\.({WEIGHTS}|{re.escape(index.name)})\.\w{{8}}')
    for old in index.parent.iterdir():
        if old.name == name or old.is_symlink() or not old.is_file():
            continue
        whole = re.fullmatch(WEIGHTS, old.name)
        if part.fullmatch(old.name) or (whole and weights_name(old.read_bytes()) == old.name):
            old.unlink()


def read_with_weights(
    read_index: Callable[[], _T], weights: Callable[[_T], Path]
) -> tuple[_T, bytes]:
    """An index and the content of its weights, of one save even while the next one replaces it.

    Args:
        read_index: Reads the index.
        weights: The file of weights that an index names.

    Raises:
        OSError: If the weights cannot be read.
    """
    while True:
        index = read_index()
        try:
            return index, weights(index).read_bytes()
        except FileNotFoundError:
            if weights(read_index()) == weights(index):
                raise


def open_log(path: Path, program: str, *, anew: bool = False) -> IO[bytes]:
    """A log of a program, begun by a line with time, machine and program, which is its mark.

    Args:
        path: The log; missing folders are created.
        program: The program and its arguments.
        anew: Whether what an earlier run left is removed first; else it is added to.

    Raises:
        FileExistsError: If there is a file that is no log of ours, or a symbolic link.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_symlink():
        raise FileExistsError(f'{path} is a symbolic link: move it elsewhere')
    log = open(path, 'a+b', buffering=0, opener=not_through_links)
    log.seek(0)
    first = log.read(_LONGEST_MARK)
    if first and not _LOG_MARK.match(first):
        log.close()
        raise FileExistsError(f'{path} exists and was not made by metagcttt: move it elsewhere')
    if anew:
        log.truncate(0)
    now = time.strftime('%Y-%m-%d %H:%M:%S')
    log.write(f'# {now} on {platform.node()}: metagcttt {program}\n'.encode())
    return log


def refuse_foreign(record: Path, *others: Path) -> None:
    """Refuse to write results where there are files of somebody else.

    Args:
        record: The file that says where the results come from: JSON with commit and versions.
            A picture without one is known by its `PICTURE_MARK`.
        others: What is written along with it; ours if the record is.

    Raises:
        FileExistsError: If one of them is there and not ours, or is a symbolic link; names it.
    """
    known = _is_ours(record)
    for path in (record, *others):
        if path.is_symlink() or (path.exists() and not (known or _is_ours(path))):
            raise FileExistsError(
                f'{path} exists and was not made by metagcttt: move it elsewhere, '
                'or choose another place'
            )


def _is_ours(path: Path) -> bool:
    if path.is_symlink() or not path.is_file():
        return False
    if path.suffix in _PICTURES:
        return PICTURE_MARK.encode() in path.read_bytes()
    try:
        content = read_json(path)
    except ValueError:
        return False
    study = content.get('study')
    return content.keys() >= _PROVENANCE or (
        isinstance(study, dict) and study.keys() >= _PROVENANCE
    )


def claim_folder(path: Path) -> None:
    """Create a folder that carries our mark, or reopen one.

    Raises:
        FileExistsError: If `path` exists without the mark, or is a symbolic link.
    """
    if not os.path.lexists(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        marked = Path(tempfile.mkdtemp(dir=path.parent, prefix=f'.{path.name}.'))
        marked.chmod(0o755)
        (marked / _MARK).touch()
        try:
            marked.rename(path)
        except OSError:  # somebody was faster
            shutil.rmtree(marked)
    if path.is_symlink() or not (path / _MARK).is_file():
        raise FileExistsError(f'{path} exists and was not made by metagcttt: move it elsewhere')


def remove_claimed(path: Path) -> None:
    """Remove a folder that `claim_folder` made; one that does not exist is fine.

    Raises:
        FileExistsError: If it does not carry our mark, or is a symbolic link.
    """
    if os.path.lexists(path):
        claim_folder(path)
        shutil.rmtree(path)
