"""Files and folders that are safe to write and to remove.

Writes are atomic: a crash leaves the old content or the new, never a part. A folder is removed
only if it carries our mark, so nothing that somebody else made is ever deleted.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import json
import os
from pathlib import Path
import shutil
import tempfile
from typing import Any, IO

_MARK = '.made-by-metagcttt'


@contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """A binary file that replaces `path` when the block ends without an error.

    Missing folders are created. On any failure, `path` keeps its old content.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(descriptor, 'wb') as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


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
