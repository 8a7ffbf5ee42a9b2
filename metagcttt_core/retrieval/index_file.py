"""A spatial index kept beside its dataset."""

import hashlib
import logging
from pathlib import Path

import numpy as np

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.errors import DatasetError
from metagcttt_core.data.npz import read_arrays
from metagcttt_core.files import atomic_write
from metagcttt_core.retrieval.config import FilterConfig
from metagcttt_core.retrieval.spatial_index import SpatialIndex

_FORMAT = 1
_REQUIRED = (
    'fingerprint',
    'order',
    'keys',
    'starts',
    'origin',
    'extent',
    'edges',
    'stride',
    'column0',
)
_log = logging.getLogger(__name__)


def open_index(dataset: TrajectoryDataset, config: FilterConfig, path: Path) -> SpatialIndex:
    """The index kept in `path`; built and written there if it is missing or of other data.

    A file that cannot be written costs only the time of building again, and is logged.
    """
    parameters = (dataset.observations, config.position_dims, config.scale, config.cell_size)
    fingerprint = _fingerprint(dataset, config)
    if path.exists():
        try:
            saved = read_arrays(path, _REQUIRED)
        except DatasetError as error:
            _log.warning('building the index again: %s', error)
        else:
            if bytes(saved['fingerprint']) == fingerprint:
                return SpatialIndex(*parameters, saved=saved)
            _log.info('building the index again: %s is of other data or settings', path)
    index = SpatialIndex(*parameters)
    try:
        with atomic_write(path) as file:
            kept = {'fingerprint': np.frombuffer(fingerprint, np.uint8), **index.arrays()}
            np.savez(file, allow_pickle=False, **kept)
    except OSError as error:
        _log.warning('the index cannot be kept in %s: %s', path, error)
    return index


def _fingerprint(dataset: TrajectoryDataset, config: FilterConfig) -> bytes:
    """Hash of everything that the index depends on: positions and settings."""
    settings = (_FORMAT, config.position_dims, config.scale, config.cell_size, dataset.num_rows)
    digest = hashlib.blake2b(repr(settings).encode(), digest_size=16)
    for dim in config.position_dims[:2]:
        digest.update(np.ascontiguousarray(dataset.observations[:, dim]).data)
    return digest.digest()
