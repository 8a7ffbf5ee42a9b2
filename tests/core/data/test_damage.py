"""Files damaged at random: their content unchanged, or a DatasetError that names the file."""

import resource

import h5py
from metagcttt_core import DatasetError, TrajectoryDataset
import numpy as np
import pytest
from tests.core.builders import random_dataset

VARIANTS = 400
ROOM = 2 << 30


def write_npz(path, dataset):
    dataset.save(path)


def write_plain_npz(path, dataset):
    np.savez(
        path,
        observations=dataset.observations,
        actions=dataset.actions,
        terminals=dataset.terminals,
    )


def write_hdf5(path, dataset):
    with h5py.File(path, 'w') as file:
        bounds = zip(dataset.episode_starts, dataset.episode_ends, strict=True)
        for number, (first, last) in enumerate(bounds):
            group = file.create_group(f'episode_{number}')
            group['observations'] = dataset.observations[first : last + 1]
            group.create_dataset(
                'actions', data=dataset.actions[first:last], compression='gzip', fletcher32=True
            )


def damage(content: bytes, rng: np.random.Generator) -> bytes:
    """Bits flipped, an end cut off, a block zeroed, or four bytes taken for a large number."""
    data = bytearray(content)
    at = int(rng.integers(len(data)))
    match rng.integers(4):
        case 0:
            for place in rng.integers(len(data), size=8):
                data[place] ^= 1 << int(rng.integers(8))
        case 1:
            del data[at:]
        case 2:
            data[at : at + 64] = bytes(len(data[at : at + 64]))
        case 3:
            data[at : at + 4] = int(rng.integers(2**32)).to_bytes(4, 'little')[: len(data) - at]
    return bytes(data)


@pytest.fixture
def bounded_memory():
    """Makes a reader fail that asks for much more memory than the files can fill."""
    used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('name', 'write', 'is_checked'),
    [
        ('data.npz', write_npz, True),
        ('data.npz', write_plain_npz, True),
        ('data.hdf5', write_hdf5, False),  # HDF5 has no checksum of its own over observations
    ],
    ids=['compressed', 'stored', 'hdf5'],
)
def test_damaged_file(tmp_path, name, write, is_checked, bounded_memory):
    path = tmp_path / name
    write(path, random_dataset([8] * 10))
    whole, content = TrajectoryDataset.load(path), path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(VARIANTS):
        path.write_bytes(damage(content, rng))
        try:
            dataset = TrajectoryDataset.load(path)
        except DatasetError as error:
            assert str(path) in str(error)
            refused += 1
        else:
            if is_checked:
                np.testing.assert_array_equal(dataset.observations, whole.observations)
                np.testing.assert_array_equal(dataset.actions, whole.actions)
                np.testing.assert_array_equal(dataset.terminals, whole.terminals)
    assert refused > VARIANTS // 4
