"""What a dataset was made from: a record that travels with it into policies and results."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import hashlib
from pathlib import Path
from typing import Any, TYPE_CHECKING

from metagcttt_core import TrajectoryDataset
from metagcttt_core.agents.config import ActorLoss

if TYPE_CHECKING:
    from metagcttt_core import Agent

_BLOCK = 1 << 20


def made_by(program: str, paths: Iterable[Path], within: Sequence[str] = ('*',)) -> dict[str, Any]:
    """The record of a program that makes a dataset.

    Args:
        program: Its name.
        paths: The files and folders that it read, in this order. Of their names the last part is
            kept: where they were on this machine means nothing on another one.
        within: Patterns of the files that were read of folders.
    """
    return {'program': program, 'sources': [_source(path, within) for path in paths]}


def identities(
    dataset: Path, checkpoints: Sequence[Path], actor_loss: ActorLoss | None = None
) -> dict[str, Any]:
    """What a report says of its data and policies.

    Args:
        dataset: The dataset.
        checkpoints: The policies.
        actor_loss: With which they are adapted; by default their own.

    Returns:
        `fingerprints`, see there, and, where the dataset says so, what it was `made_from`; that is
        no part of the former, since equal data are equal wherever they come from.

    Raises:
        ValueError: If one cannot be read, or the data are none for a policy; see `Agent.check`.
    """
    data, agents = _read(dataset, checkpoints, actor_loss)
    for agent in agents:
        agent.check(data)
    made_from = {'made_from': data.made_from} if data.made_from else {}
    return {'fingerprints': _hashes(data, agents), **made_from}


@contextmanager
def unchanged(dataset: Path, checkpoints: Sequence[Path]) -> Iterator[dict[str, Any]]:
    """The `identities` of data and policies that nodes read while this lasts.

    Raises:
        ValueError: If they are others at the end.
    """
    known = identities(dataset, checkpoints)
    yield known
    check_fingerprints(checkpoints[0], known, fingerprints(dataset, checkpoints))


def fingerprints(
    dataset: Path, checkpoints: Sequence[Path], actor_loss: ActorLoss | None = None
) -> dict[str, Any]:
    """Hashes of a dataset and of policies, as they are adapted, whether they fit or not."""
    return _hashes(*_read(dataset, checkpoints, actor_loss))


def _read(
    dataset: Path, checkpoints: Sequence[Path], actor_loss: ActorLoss | None
) -> tuple[TrajectoryDataset, list['Agent']]:
    from metagcttt_core import load_checkpoint

    changes = {'actor_loss': actor_loss} if actor_loss else {}
    # First, as they are read sooner than data.
    agents = [load_checkpoint(path, changes=changes) for path in checkpoints]
    return TrajectoryDataset.load(dataset), agents


def _hashes(data: TrajectoryDataset, agents: Sequence['Agent']) -> dict[str, Any]:
    return {'dataset': data.fingerprint, 'policies': [agent.fingerprint() for agent in agents]}


def check_fingerprints(file: Path, report: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse results of other data or policies than those that are there now.

    Raises:
        ValueError: If one differs; names the file, and what differs.
    """
    for name, was in report.get('fingerprints', {}).items():
        if was != now.get(name):
            raise ValueError(f'{file}: is of other {name}, was {was!r} and is now {now[name]!r}')


def in_words(made_from: dict[str, Any]) -> str:
    """A record as a line of text."""
    named = [f'{each["name"]} ({each["fingerprint"]})' for each in made_from['sources']]
    return f'made by {made_from["program"]} from {", ".join(named)}'


def _source(path: Path, within: Sequence[str]) -> dict[str, Any]:
    """Name, size in bytes and hash of the content of a file, or of all files in a folder."""
    files = [path]
    if path.is_dir():
        files = sorted(f for pattern in within for f in path.glob(pattern) if f.is_file())
    digest, size = hashlib.blake2b(digest_size=8), 0
    for file in files:
        if path.is_dir():
            digest.update(f'{file.relative_to(path).as_posix()}\0{file.stat().st_size}\0'.encode())
        with file.open('rb') as content:
            while block := content.read(_BLOCK):
                digest.update(block)
                size += len(block)
    return {'name': path.absolute().name, 'bytes': size, 'fingerprint': digest.hexdigest()}
