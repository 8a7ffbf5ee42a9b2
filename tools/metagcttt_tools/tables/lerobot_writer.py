"""Writing of LeRobotDataset v3."""

from collections.abc import Iterator, Mapping
import json
from pathlib import Path
from typing import Any

from metagcttt_core import TrajectoryDataset
from metagcttt_core.files import atomic_write, write_json
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from metagcttt_tools.tables.lerobot import ACTION, STATE

DATA_PATH = 'data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet'
_EPISODES_PATH = 'meta/episodes/chunk-000/file-000.parquet'
_FILES_A_CHUNK = 1000
_QUANTILES = {'q01': 0.01, 'q10': 0.1, 'q50': 0.5, 'q90': 0.9, 'q99': 0.99}


def write_lerobot(
    folder: Path,
    dataset: TrajectoryDataset,
    *,
    fps: int,
    task: str,
    robot: str,
    observed: list[str],
    commanded: list[str],
    actions: np.ndarray,
    rows_a_file: int,
) -> None:
    """Write the trajectories as episodes, a row a frame, in an empty folder.

    The last row of a trajectory is written too, with `next.done`; its action was never taken.

    Args:
        folder: Where to write `meta` and `data`.
        dataset: The trajectories.
        fps: Rows a second.
        task: What the robot does, in words.
        robot: Its name.
        observed: The names of the values of an observation.
        commanded: The names of the values of an action.
        actions: (N, act_dim) the actions to write, such as those in units of the robot.
        rows_a_file: Rows from which the next trajectory goes into a new file.
    """
    lengths = dataset.episode_ends - dataset.episode_starts + 1
    frames = np.arange(dataset.num_rows) - np.repeat(dataset.episode_starts, lengths)
    columns = {
        STATE: np.asarray(dataset.states(slice(None))),
        ACTION: actions.astype(np.float32),
        'next.done': np.asarray(dataset.terminals),
        'timestamp': (frames / fps).astype(np.float32),
        'frame_index': frames,
        'episode_index': np.repeat(np.arange(dataset.num_episodes), lengths),
        'index': np.arange(dataset.num_rows),
        'task_index': np.zeros(dataset.num_rows, np.int64),
    }
    names = {STATE: observed, ACTION: commanded}
    episodes: list[dict[str, Any]] = []
    for file, (first, last) in enumerate(_files(lengths, rows_a_file)):
        start, stop = int(dataset.episode_starts[first]), int(dataset.episode_ends[last]) + 1
        chunk_index, file_index = divmod(file, _FILES_A_CHUNK)
        path = folder / DATA_PATH.format(chunk_index=chunk_index, file_index=file_index)
        _write(path, pa.table({name: _array(c[start:stop]) for name, c in columns.items()}))
        for number in range(first, last + 1):
            start, stop = int(dataset.episode_starts[number]), int(dataset.episode_ends[number])
            here = {name: column[start : stop + 1] for name, column in columns.items()}
            episodes.append(
                {
                    'episode_index': number,
                    'tasks': [task],
                    'length': stop + 1 - start,
                    'dataset_from_index': start,
                    'dataset_to_index': stop + 1,
                    'data/chunk_index': chunk_index,
                    'data/file_index': file_index,
                    'meta/episodes/chunk_index': 0,
                    'meta/episodes/file_index': 0,
                    **{
                        f'stats/{name}/{kind}': values
                        for name, column in here.items()
                        for kind, values in statistics(column).items()
                    },
                }
            )
    _write(folder / _EPISODES_PATH, pa.Table.from_pylist(episodes))
    _write(folder / 'meta' / 'tasks.parquet', _tasks(task))
    write_json(
        folder / 'meta' / 'stats.json',
        {name: statistics(column) for name, column in columns.items()},
    )
    write_json(
        folder / 'meta' / 'info.json',
        {
            'codebase_version': 'v3.0',
            'robot_type': robot,
            'total_episodes': dataset.num_episodes,
            'total_frames': dataset.num_rows,
            'total_tasks': 1,
            'chunks_size': _FILES_A_CHUNK,
            'data_files_size_in_mb': 100,
            'video_files_size_in_mb': 200,
            'fps': fps,
            'splits': {'train': f'0:{dataset.num_episodes}'},
            'data_path': DATA_PATH,
            'video_path': None,
            'features': {
                name: {
                    'dtype': str(column.dtype),
                    'shape': [column.shape[1] if column.ndim == 2 else 1],
                    'names': names.get(name),
                }
                for name, column in columns.items()
            },
        },
    )


def statistics(column: np.ndarray) -> dict[str, list[Any]]:
    """Extremes, mean, deviation and quantiles by value, and the number of rows."""
    values = column.reshape(len(column), -1)
    numbers = values.astype(np.float64)
    return {
        'min': values.min(axis=0).tolist(),
        'max': values.max(axis=0).tolist(),
        'mean': numbers.mean(axis=0).tolist(),
        'std': numbers.std(axis=0).tolist(),
        'count': [len(column)],
        **{name: np.quantile(numbers, q, axis=0).tolist() for name, q in _QUANTILES.items()},
    }


def _files(lengths: np.ndarray, rows_a_file: int) -> Iterator[tuple[int, int]]:
    """The first and the last trajectory of each file."""
    first, rows = 0, 0
    for number, length in enumerate(lengths):
        rows += int(length)
        if rows >= rows_a_file or number == len(lengths) - 1:
            yield first, number
            first, rows = number + 1, 0


def _array(column: np.ndarray) -> pa.Array:
    # LeRobot's reader takes lists of one value for plain numbers.
    if column.ndim == 1 or column.shape[1] == 1:
        return pa.array(column.reshape(-1))
    return pa.FixedSizeListArray.from_arrays(
        pa.array(np.ascontiguousarray(column).reshape(-1)), column.shape[1]
    )


def _tasks(task: str) -> pa.Table:
    """The table of tasks, whose texts are the index of LeRobot's data frame."""
    described = [
        {'name': 'task_index', 'pandas_type': 'int64', 'numpy_type': 'int64'},
        {'name': 'task', 'pandas_type': 'unicode', 'numpy_type': 'object'},
    ]
    pandas: Mapping[str, Any] = {
        'index_columns': ['task'],
        'column_indexes': [],
        'columns': [{**each, 'field_name': each['name'], 'metadata': None} for each in described],
        'pandas_version': '2.0.0',
    }
    table = pa.table({'task_index': [0], 'task': [task]})
    return table.replace_schema_metadata({'pandas': json.dumps(pandas)})


def _write(path: Path, table: pa.Table) -> None:
    with atomic_write(path) as file:
        pq.write_table(table, file, compression='snappy', write_page_checksum=True)
