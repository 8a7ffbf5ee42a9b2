"""The spatial index kept in a file beside its dataset."""

import logging

from metagcttt_core import FilterConfig, TrajectoryDataset, TrajectoryFilter
from metagcttt_core.retrieval.spatial_index import SpatialIndex
import numpy as np
import pytest

from tests.core.builders import random_dataset

CONFIG = FilterConfig(epsilon=2.0, top_percent=100)


@pytest.fixture
def dataset() -> TrajectoryDataset:
    return random_dataset([40, 40, 40], obs_dim=3, seed=1)


@pytest.fixture
def count_builds(monkeypatch):
    """The number of times an index was built, as a list that grows."""
    built, build = [], SpatialIndex._build
    monkeypatch.setattr(
        SpatialIndex, '_build', lambda index: (built.append(1), build(index)) and None
    )
    return built


def assert_same_answers(dataset, config, finder) -> None:
    fresh = TrajectoryFilter(dataset, config)
    kept = 0
    for row in range(0, dataset.num_rows, 7):
        state, goal = dataset.observations[row], dataset.observations[(row + 15) % 120]
        support = finder.query(state, goal)
        assert support == fresh.query(state, goal)
        kept += support.num_kept
    assert kept


@pytest.mark.parametrize('dims', [(0,), (0, 1), (2, 0, 1)])
def test_kept_index_is_loaded_instead_of_built(tmp_path, dataset, dims, count_builds):
    config = CONFIG.model_copy(update={'position_dims': dims})
    TrajectoryFilter(dataset, config, tmp_path / 'index.npz')
    finder = TrajectoryFilter(dataset, config, tmp_path / 'index.npz')
    assert len(count_builds) == 1
    assert_same_answers(dataset, config, finder)


@pytest.mark.parametrize(
    'changes',
    [{'epsilon': 1.0}, {'position_dims': (0, 2)}, {'scale': (1.0, 2.0)}],
    ids=['epsilon', 'dims', 'scale'],
)
def test_index_of_other_settings_is_built_again(tmp_path, dataset, changes, count_builds):
    TrajectoryFilter(dataset, CONFIG, tmp_path / 'index.npz')
    config = CONFIG.model_copy(update=changes)
    finder = TrajectoryFilter(dataset, config, tmp_path / 'index.npz')
    assert len(count_builds) == 2
    assert_same_answers(dataset, config, finder)


def test_index_of_other_data_is_built_again(tmp_path, dataset, count_builds):
    TrajectoryFilter(dataset, CONFIG, tmp_path / 'index.npz')
    moved = dataset.observations.copy()
    moved[60, 1] += 0.5
    changed = TrajectoryDataset.from_arrays(moved, dataset.actions, dataset.terminals)
    for _ in range(2):
        finder = TrajectoryFilter(changed, CONFIG, tmp_path / 'index.npz')
    assert len(count_builds) == 2
    assert_same_answers(changed, CONFIG, finder)


@pytest.mark.parametrize('content', [b'', b'no index', None], ids=['empty', 'text', 'truncated'])
def test_damaged_index_is_built_again_and_logged(tmp_path, dataset, content, count_builds, caplog):
    path = tmp_path / 'index.npz'
    TrajectoryFilter(dataset, CONFIG, path)
    path.write_bytes(path.read_bytes()[:-40] if content is None else content)
    with caplog.at_level(logging.WARNING):
        finder = TrajectoryFilter(dataset, CONFIG, path)
    assert 'building the index again' in caplog.text
    assert str(path) in caplog.text
    assert len(count_builds) == 2
    TrajectoryFilter(dataset, CONFIG, path)
    assert len(count_builds) == 2
    assert_same_answers(dataset, CONFIG, finder)


def test_index_that_cannot_be_kept_is_logged_and_works(tmp_path, dataset, caplog):
    (tmp_path / 'file').write_text('in the way')
    with caplog.at_level(logging.WARNING):
        finder = TrajectoryFilter(dataset, CONFIG, tmp_path / 'file' / 'index.npz')
    assert 'cannot be kept' in caplog.text
    assert_same_answers(dataset, CONFIG, finder)


def test_index_file_is_never_unpickled(tmp_path, dataset, count_builds):
    path = tmp_path / 'index.npz'
    TrajectoryFilter(dataset, CONFIG, path)
    with np.load(path) as arrays:
        kept = dict(arrays)
    np.savez(path, **{**kept, 'order': np.array([{}], dtype=object)})
    TrajectoryFilter(dataset, CONFIG, path)
    assert len(count_builds) == 2
