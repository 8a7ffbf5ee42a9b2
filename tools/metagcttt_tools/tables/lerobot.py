"""Reading of LeRobotDataset v3: parquet files of rows, and of what is known of each episode."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
import re
from typing import Annotated, Any

from metagcttt_core.config import error_lines
from metagcttt_core.data import DatasetError
from metagcttt_core.files import read_json
import numpy as np
from numpy.typing import NDArray
import pyarrow as pa
from pydantic import BaseModel, Field, ValidationError

from metagcttt_tools.tables.columns import ColumnMap, CommandColumn, ObservedColumn
from metagcttt_tools.tables.files import numbers, read_parquet
from metagcttt_tools.tables.rows import changes, Found, make_rows, Rows, to_dataset

STATE, ACTION = 'observation.state', 'action'
READ = ('meta/**/*', 'data/**/*')
"""Patterns of the files that are read."""
DEFAULT_MAP = ColumnMap(
    observations=(ObservedColumn(column=STATE),), actions=(CommandColumn(column=ACTION),)
)
_COUNTS = ('episode_index', 'frame_index', 'index')
_HOW_TO_TRUST = '; --trust-rows goes by the rows'
_EPISODE = (
    *('episode_index', 'length', 'dataset_from_index', 'dataset_to_index'),
    *('data/chunk_index', 'data/file_index'),
)
_INDEX = re.compile(r'\{(chunk_index|file_index)(:\d{1,2}d)?\}')
_PICTURES = ('video', 'image')


class Feature(BaseModel):
    """A column, as info.json describes it."""

    dtype: str
    shape: tuple[Annotated[int, Field(ge=0)], ...]
    names: Any = None

    @property
    def value_names(self) -> list[str]:
        """The names of the values of a list, where there is one each."""
        given = self.names
        while isinstance(given, dict) and len(given) == 1:  # {"motors": [...]}
            [given] = given.values()
        named = isinstance(given, list) and all(isinstance(name, str) for name in given)
        return given if named and self.shape == (len(given),) and len(set(given)) > 1 else []


class Info(BaseModel):
    """What meta/info.json has to say; other keys are not looked at."""

    codebase_version: str
    fps: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    total_episodes: Annotated[int, Field(ge=0)]
    total_frames: Annotated[int, Field(ge=0)]
    data_path: str
    features: dict[str, Feature]
    robot_type: str | None = None


@dataclass(frozen=True)
class _Episode:
    number: int
    start: int
    stop: int
    file: PurePosixPath


def is_lerobot(path: Path) -> bool:
    """True for the folder of a LeRobot dataset, of whatever version."""
    return (path / 'meta' / 'info.json').is_file()


def read_lerobot(
    folder: Path,
    columns: ColumnMap = DEFAULT_MAP,
    *,
    trust_rows: bool = False,
    limits_from_data: bool = False,
) -> Found:
    """The trajectories of a LeRobotDataset v3, cut where `episode_index` changes.

    Args:
        folder: The folder that holds `meta` and `data`.
        columns: Which features are observed and commanded; columns of times and rules for cuts are
            LeRobot's own.
        trust_rows: Go by the rows where meta/episodes or meta/info.json say otherwise.
        limits_from_data: See `to_dataset`.

    Raises:
        DatasetError: If it is no LeRobotDataset v3, a file is missing, damaged or was never
            finished, a feature is missing or a picture, or the metadata do not fit the rows.
    """
    info = _read_info(folder)
    features = columns.columns
    for name in features:
        _must_be_numbers(folder, info, name)
    names = {name: info.features[name].value_names for name in features}
    episodes = _read_episodes(folder, info)
    parts = []
    index = 0
    for file in dict.fromkeys(episode.file for episode in episodes):
        path = folder / file
        table = read_parquet(path, [*_COUNTS, *features])
        if not len(table):
            raise DatasetError(f'{path}: has no rows')
        inside = [episode for episode in episodes if episode.file == file]
        for name in features:
            _compare_width(table, name, info.features[name], path)
        if not trust_rows:
            _compare(table, inside, path, index)
        parts.append(_rows(table, columns, names, info, path))
        index += len(table)
    found = (len(episodes), index)
    if not trust_rows and found != (info.total_episodes, info.total_frames):
        raise DatasetError(
            f'{folder}: meta/info.json counts {info.total_episodes} episodes and '
            f'{info.total_frames} frames; there are {found[0]} and {found[1]}{_HOW_TO_TRUST}'
        )
    return to_dataset(parts, columns, limits_from_data=limits_from_data)


def _read_info(folder: Path) -> Info:
    path = folder / 'meta' / 'info.json'
    try:
        values = read_json(path)
    except FileNotFoundError as error:
        raise DatasetError(f'{folder}: no LeRobot dataset there, expected {path}') from error
    except (OSError, ValueError) as error:
        raise DatasetError(f'{path}: cannot be read ({error})') from error
    version = str(values.get('codebase_version'))
    if not version.startswith('v3.'):
        hint = (
            '; python -m lerobot.datasets.v30.convert_dataset_v21_to_v30 of LeRobot converts it'
            if version.startswith('v2.')
            else ''
        )
        raise DatasetError(f'{path}: codebase_version is {version}, not v3{hint}')
    try:
        return Info.model_validate(values)
    except ValidationError as error:
        raise DatasetError(f'{path}: {"; ".join(error_lines(error))}') from error


def _must_be_numbers(folder: Path, info: Info, name: str) -> None:
    listed = ', '.join(f'{key} ({each.dtype})' for key, each in info.features.items())
    feature = info.features.get(name)
    if feature is None:
        raise DatasetError(f'{folder}: has no feature {name} (there are: {listed})')
    if feature.dtype in _PICTURES:
        raise DatasetError(
            f'{folder}: {name} is a {feature.dtype}; policies here take numbers (there are: '
            f'{listed})'
        )
    if len(feature.shape) != 1:
        raise DatasetError(f'{folder}: {name} has shape {feature.shape}, expected one dimension')


def _read_episodes(folder: Path, info: Info) -> list[_Episode]:
    """What meta/episodes says, in its order."""
    paths = sorted((folder / 'meta' / 'episodes').glob('*/*.parquet'))
    if not paths:
        raise DatasetError(
            f'{folder}: meta/episodes holds no parquet files; was the recording finished?'
        )
    episodes = []
    for path in paths:
        table = read_parquet(path, _EPISODE)
        columns = [numbers(table, name, str(path))[:, 0].astype(int).tolist() for name in _EPISODE]
        for number, length, start, stop, chunk, file in zip(*columns, strict=True):
            if stop - start != length:
                raise DatasetError(
                    f'{path}: episode {number} has length {length} but rows {start} to {stop}'
                )
            episodes.append(_Episode(number, start, stop, _data_file(folder, info, chunk, file)))
    return episodes


def _data_file(folder: Path, info: Info, chunk: int, file: int) -> PurePosixPath:
    if '{' in _INDEX.sub('', info.data_path) or '}' in _INDEX.sub('', info.data_path):
        raise DatasetError(
            f'{folder}: meta/info.json: data_path {info.data_path!r} takes more than chunk_index '
            'and file_index, of at most 99 digits'
        )
    path = PurePosixPath(info.data_path.format(chunk_index=chunk, file_index=file))
    if path.is_absolute() or '..' in path.parts or '\0' in str(path):
        raise DatasetError(f'{folder}: meta/info.json: data_path leads out of the folder: {path}')
    return path


def _rows(
    table: pa.Table, columns: ColumnMap, names: Mapping[str, list[str]], info: Info, path: Path
) -> Rows:
    """The rows of one file, whose own counts tell whether they are complete."""
    episodes, frames = _counts(table, 'episode_index', path), _counts(table, 'frame_index', path)
    ends = np.arange(len(table)) == len(table) - 1
    ends[:-1] |= changes(episodes, 'episode_index', str(path))
    starts = np.concatenate([[True], ends[:-1]])
    expected = np.where(starts, 0, np.roll(frames, 1) + 1)
    wrong = np.flatnonzero(frames != expected)
    if len(wrong):
        row = wrong[0]
        raise DatasetError(
            f'{path}: frame_index of episode {episodes[row]} is {frames[row]} in row {row}, '
            f'expected {expected[row]}: frames are missing'
        )
    return make_rows(table, columns, names, ends, frames / info.fps, str(path))


def _counts(table: pa.Table, name: str, path: Path) -> NDArray[np.int64]:
    return numbers(table, name, str(path))[:, 0].astype(np.int64)


def _compare_width(table: pa.Table, name: str, feature: Feature, path: Path) -> None:
    """Refuse rows of other lengths than meta/info.json announces."""
    width = numbers(table, name, str(path)).shape[1]
    if (width,) != feature.shape:
        raise DatasetError(
            f'{path}: {name} has {width} values in a row, but shape {feature.shape} by '
            'meta/info.json'
        )


def _compare(table: pa.Table, episodes: list[_Episode], path: Path, first: int) -> None:
    """Refuse a file whose rows are elsewhere than the metadata and their own index say."""
    numbered, index = _counts(table, 'episode_index', path), _counts(table, 'index', path)
    wrong = np.flatnonzero(index != first + np.arange(len(index)))
    if len(wrong):
        row = wrong[0]
        raise DatasetError(
            f'{path}: index is {index[row]} in row {row}, but there are {first + row} rows before '
            f'it{_HOW_TO_TRUST}'
        )
    for episode in episodes:
        inside = index[numbered == episode.number]
        there = f'{inside[0]} to {inside[-1] + 1}' if len(inside) else 'not in this file'
        if there != f'{episode.start} to {episode.stop}':
            raise DatasetError(
                f'{path}: episode {episode.number} is rows {episode.start} to {episode.stop} by '
                f'meta/episodes, but by its rows {there}{_HOW_TO_TRUST}'
            )
    if extra := sorted(set(numbered.tolist()) - {episode.number for episode in episodes}):
        raise DatasetError(
            f'{path}: episode {extra[0]} is in the rows but not in meta/episodes{_HOW_TO_TRUST}'
        )
