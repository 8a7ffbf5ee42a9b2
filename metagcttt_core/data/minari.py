"""Reading Minari's and D4RL's datasets (HDF5) of goal-reaching robots."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from metagcttt_core.data.bounds import check_announced, check_memory
from metagcttt_core.data.errors import DatasetError
from metagcttt_core.data.marks import (
    END_MARKS,
    is_following,
    looks_like_a_mark,
    looks_like_time,
    may_divide_rows,
)

SUFFIXES = ('.hdf5', '.h5')
_PER_ROW_INFOS = ('qpos', 'qvel')
_LARGEST_CHUNK = 64 << 20
"""Bytes of a chunk that is larger than its array; HDF5 unpacks whole chunks."""


def is_minari(path: Path) -> bool:
    """True for the path of a Minari dataset: its folder, or its file by the suffix."""
    return path.is_dir() or path.suffix in SUFFIXES


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Rows of a Minari dataset, episodes back to back by number.

    An episode of T transitions has T + 1 observations and T actions, and becomes T + 1 rows::

        observations   s0   s1   s2   s3
        actions        a0   a1   a2   0       (the last row is never taken)
        terminals       F    F    F    T

    Observations that are dictionaries with `observation` and `achieved_goal`, as those of
    gymnasium-robotics, become vectors that begin with the achieved goal: it is put in front unless
    `observation` begins with it anyway. `desired_goal` is left out.

    A file in D4RL's layout has arrays of all rows instead, with `terminals` and `timeouts`.

    Args:
        path: `main_data.hdf5`, the folder `data` that holds it, or the folder above. Or D4RL's
            file.

    Returns:
        `observations`, `actions` and `terminals`, and `qpos` and `qvel` where it has them; of
        D4RL's layout other marks of ends and `next_observations`, too.

    Raises:
        DatasetError: If there is no such dataset, it is damaged, or an episode does not fit.
    """
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise DatasetError(
            f'{path}: reading Minari datasets takes h5py: pip install "metagcttt-core[minari]"'
        ) from error
    file_path = _file_of(path)
    try:
        with h5py.File(file_path, 'r') as file:
            if hasattr(file.get('observations'), 'dtype'):
                return _flat(file, file_path)
            names, episodes = _episode_names(file, path), []
            num_bytes = 0
            for name in names:
                episodes.append(_episode(file, name, file_path))
                num_bytes += sum(array.nbytes for array in episodes[-1].values())
                check_memory(2 * num_bytes, str(file_path))  # they are joined in the end
            return _join(episodes, path)
    except DatasetError:
        raise
    # HDF5 raises any of these for a damaged file, at whatever is read first.
    except (OSError, RuntimeError, ValueError, LookupError, TypeError, MemoryError) as error:
        raise DatasetError(f'{file_path}: not a complete HDF5 file ({error})') from error


def _file_of(path: Path) -> Path:
    candidates = [path / 'data' / 'main_data.hdf5', path / 'main_data.hdf5', path]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise DatasetError(
        f'{path}: no Minari dataset there, expected {candidates[0]} (one stored as Arrow has '
        'to be converted first)'
        if path.is_dir()
        else f'{path}: no such file'
    )


def _episode_names(file: Any, path: Path) -> list[str]:
    numbers = sorted(
        int(name[8:]) for name in file if name.startswith('episode_') and name[8:].isdigit()
    )
    for expected, number in enumerate(numbers):
        if number != expected:
            raise DatasetError(f'{path}: episode {expected} is missing of {numbers[-1] + 1}')
    return [f'episode_{number}' for number in numbers]


def _episode(file: Any, name: str, path: Path) -> dict[str, np.ndarray]:
    group = _member(file, name, path)
    if not hasattr(group, 'keys'):
        raise DatasetError(f'{path}: {name} must be a group, got an array')
    for required in ('observations', 'actions'):
        if required not in group:
            raise DatasetError(f'{path}: {name} has no {required}; found: {", ".join(group)}')
    actions = _array(group, 'actions', path)
    observations = _observations(group, path)
    num_rows = len(actions) + 1
    if len(observations) != num_rows:
        raise DatasetError(
            f'{path}: {name} has {len(actions)} actions but {len(observations)} observations, '
            f'expected {num_rows}'
        )
    for mark in filter(group.__contains__, END_MARKS):
        before = np.flatnonzero(_vector(group, mark, path)[: len(actions) - 1])
        if len(before):
            raise DatasetError(
                f'{path}: {name} ends after transition {before[0]} by its {mark}, but has '
                f'{len(actions)}: store what comes after an end as another episode'
            )
    rows = {'observations': observations, **_infos(group, num_rows, path)}
    rows['actions'] = np.concatenate([actions, np.zeros_like(actions[:1])])
    rows['terminals'] = np.arange(num_rows) == num_rows - 1
    return rows


def _flat(file: Any, path: Path) -> dict[str, np.ndarray]:
    """The rows of a file in D4RL's layout."""
    for required in ('actions', 'terminals'):
        if required not in file:
            raise DatasetError(f'{path}: has no {required}; found: {", ".join(file)}')
    names = ['observations', 'actions', *filter(is_following, file)]
    rows = {name: _array(file, name, path) for name in names}
    num_rows = len(rows['observations'])
    infos = _own_member(file, 'infos')
    for group in (file, infos) if hasattr(infos, 'keys') else (file,):
        for name in group:
            rows |= _mark(group, name, num_rows, path)
    return {**rows, **_infos(file, num_rows, path)}


def _mark(group: Any, name: str, num_rows: int, path: Path) -> dict[str, np.ndarray]:
    """An array that may say where trajectories end, by its name; empty if it is none."""
    node = _own_member(group, name)
    shape = getattr(node, 'shape', None)
    of_rows = shape in ((num_rows,), (num_rows, 1))
    if of_rows and looks_like_time(name) and _is_number(node):
        return {name: _stored(node, name, path)}
    if shape and _is_number(node) and may_divide_rows(shape, node.dtype, num_rows):
        return {name: _stored(node, name, path)}
    if not looks_like_a_mark(name, of_rows=of_rows):
        return {}
    node = _member(group, name, path)
    if not of_rows and (shape is None or len(shape) < 2 or shape[0] != num_rows):
        raise DatasetError(f'{path}: {name} must have a value for each row')
    return {name: _stored(node, name, path)} if of_rows else {}


def _infos(group: Any, num_rows: int, path: Path) -> dict[str, np.ndarray]:
    """The states of the physics at each row, where they are; other infos are not looked at."""
    infos = _own_member(group, 'infos')
    return {
        name: _array(infos, name, path)
        for name in _PER_ROW_INFOS
        if hasattr(infos, 'keys') and _is_table(_own_member(infos, name), num_rows)
    }


def _observations(group: Any, path: Path) -> np.ndarray:
    node = _member(group, 'observations', path)
    if not hasattr(node, 'keys'):
        return _array(group, 'observations', path)
    if 'observation' not in node or 'achieved_goal' not in node:
        raise DatasetError(
            f'{path}: {node.name[1:]} must hold observation and achieved_goal, '
            f'found: {", ".join(node)}'
        )
    observation = _array(node, 'observation', path)
    achieved = _array(node, 'achieved_goal', path)
    if len(observation) != len(achieved):
        raise DatasetError(
            f'{path}: {group.name[1:]} has {len(observation)} observations '
            f'but {len(achieved)} achieved goals'
        )
    first = observation[:, : achieved.shape[1]]
    if np.array_equal(first.astype(np.float32), achieved.astype(np.float32)):
        return observation
    return np.concatenate([achieved, observation], axis=1)


def _own_member(group: Any, name: str) -> Any:
    """The member of a group; none where there is no such, or a link to other files or places."""
    own = type(group.get(name, getlink=True)).__name__ == 'HardLink'
    return group[name] if own else None


def _member(group: Any, name: str, path: Path) -> Any:
    """The member of a group that has one of that name; links are refused."""
    node = _own_member(group, name)
    if node is None:
        raise DatasetError(f'{path}: {group.name}/{name} is a link, which is not followed')
    return node


def _is_number(node: Any) -> bool:
    return hasattr(node, 'dtype') and node.dtype.kind in 'fiu'


def _is_table(node: Any, num_rows: int | None = None) -> bool:
    """True for numbers of shape (rows, numbers)."""
    shape = getattr(node, 'shape', None) or (0,)
    return (
        hasattr(node, 'dtype')
        and node.dtype.kind in 'fiu'
        and len(shape) == 2
        and (shape[0] > 0 if num_rows is None else shape[0] == num_rows)
    )


def _array(group: Any, name: str, path: Path) -> np.ndarray:
    """One stored array of shape (rows, numbers); anything else is refused."""
    node = _member(group, name, path)
    name = f'{group.name[1:]}/{name}'
    if not _is_table(node):
        got = f'{node.dtype} of shape {node.shape}' if hasattr(node, 'dtype') else 'a group'
        raise DatasetError(f'{path}: {name} must be numbers of shape (rows, numbers), got {got}')
    return _stored(node, name, path)


def _vector(group: Any, name: str, path: Path) -> np.ndarray:
    """One stored array of a value for each step; anything else is refused."""
    node = _member(group, name, path)
    if not hasattr(node, 'dtype') or node.dtype.kind not in 'bfiu' or len(node.shape) != 1:
        raise DatasetError(f'{path}: {group.name[1:]}/{name} must be a flag for each step')
    return _stored(node, f'{group.name[1:]}/{name}', path)


def _stored(node: Any, name: str, path: Path) -> np.ndarray:
    """The content of an array, if it is there and no more than fits."""
    stored = min(node.id.get_storage_size(), path.stat().st_size)
    check_announced(node.nbytes, stored, f'{path}: {name}')
    chunk_bytes = math.prod(node.chunks or ()) * node.dtype.itemsize
    if chunk_bytes > max(node.nbytes, _LARGEST_CHUNK):
        raise DatasetError(
            f'{path}: {name} holds {node.nbytes} bytes in chunks of {chunk_bytes}, which are too '
            f'large (at most {_LARGEST_CHUNK})'
        )
    check_memory(node.nbytes, f'{path}: {name}')
    return np.asarray(node[()])


def _join(episodes: list[dict[str, np.ndarray]], path: Path) -> dict[str, np.ndarray]:
    if not episodes:
        raise DatasetError(f'{path}: holds no episodes')
    everywhere = set.intersection(*(set(episode) for episode in episodes))
    fields = [name for name in episodes[0] if name in everywhere]  # some may lack infos
    for number, episode in enumerate(episodes):
        shapes = {name: episode[name].shape[1:] for name in fields}
        expected = {name: episodes[0][name].shape[1:] for name in fields}
        if shapes != expected:
            raise DatasetError(
                f'{path}: episode {number} has fields {shapes}, the first one has {expected}'
            )
    return {name: np.concatenate([episode[name] for episode in episodes]) for name in fields}
