"""Reading Minari datasets (HDF5) of goal-reaching robots."""

from pathlib import Path
from typing import Any

import numpy as np

from metagcttt_core.data.errors import DatasetError

SUFFIXES = ('.hdf5', '.h5')
_PER_ROW_INFOS = ('qpos', 'qvel')


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

    Args:
        path: `main_data.hdf5`, the folder `data` that holds it, or the folder above.

    Returns:
        `observations`, `actions` and `terminals`, and `qpos` and `qvel` where it has them.

    Raises:
        DatasetError: If there is no such dataset, it is damaged, or an episode does not fit.
    """
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise DatasetError(
            f'{path}: reading Minari datasets takes h5py: pip install -c constraints.txt h5py'
        ) from error
    file_path = _file_of(path)
    try:
        with h5py.File(file_path, 'r') as file:
            return _join([_episode(file, name, file_path) for name in _episode_names(file)], path)
    except OSError as error:
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


def _episode_names(file: Any) -> list[str]:
    names = [name for name in file if name.startswith('episode_') and name[8:].isdigit()]
    return sorted(names, key=lambda name: int(name[8:]))


def _episode(file: Any, name: str, path: Path) -> dict[str, np.ndarray]:
    group = file[name]
    for required in ('observations', 'actions'):
        if required not in group:
            raise DatasetError(f'{path}: {name} has no {required}; found: {", ".join(group)}')
    actions = _array(group['actions'], f'{name}/actions', path)
    rows = {'observations': _observations(group['observations'], name, path)}
    infos = group.get('infos', {})
    for info in _PER_ROW_INFOS:
        if info in infos:
            rows[info] = _array(infos[info], f'{name}/infos/{info}', path)
    num_rows = len(actions) + 1
    for field, values in rows.items():
        if len(values) != num_rows:
            raise DatasetError(
                f'{path}: {name} has {len(actions)} actions but {len(values)} {field}, '
                f'expected {num_rows}'
            )
    rows['actions'] = np.concatenate([actions, np.zeros_like(actions[:1])])
    rows['terminals'] = np.arange(num_rows) == num_rows - 1
    return rows


def _observations(node: Any, name: str, path: Path) -> np.ndarray:
    if not hasattr(node, 'keys'):
        return _array(node, f'{name}/observations', path)
    if 'observation' not in node or 'achieved_goal' not in node:
        raise DatasetError(
            f'{path}: {name}/observations must hold observation and achieved_goal, '
            f'found: {", ".join(node)}'
        )
    observation = _array(node['observation'], f'{name}/observations/observation', path)
    achieved = _array(node['achieved_goal'], f'{name}/observations/achieved_goal', path)
    if np.array_equal(observation[:, : achieved.shape[1]], achieved):
        return observation
    if len(observation) != len(achieved):
        raise DatasetError(
            f'{path}: {name} has {len(observation)} observations '
            f'but {len(achieved)} achieved goals'
        )
    return np.concatenate([achieved, observation], axis=1)


def _array(node: Any, name: str, path: Path) -> np.ndarray:
    """One stored array of shape (rows, numbers); anything else is refused."""
    if (
        not hasattr(node, 'dtype')
        or node.dtype.kind not in 'fiu'
        or node.ndim != 2
        or not len(node)
    ):
        got = f'{node.dtype} of shape {node.shape}' if hasattr(node, 'dtype') else 'a group'
        raise DatasetError(f'{path}: {name} must be numbers of shape (rows, numbers), got {got}')
    return np.asarray(node[()])


def _join(episodes: list[dict[str, np.ndarray]], path: Path) -> dict[str, np.ndarray]:
    if not episodes:
        raise DatasetError(f'{path}: holds no episodes')
    fields = episodes[0].keys()
    for number, episode in enumerate(episodes):
        shapes = {name: values.shape[1:] for name, values in episode.items()}
        expected = {name: episodes[0][name].shape[1:] for name in fields}
        if shapes != expected:
            raise DatasetError(
                f'{path}: episode {number} has fields {shapes}, the first one has {expected}'
            )
    return {name: np.concatenate([episode[name] for episode in episodes]) for name in fields}
