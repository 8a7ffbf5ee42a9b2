"""OGBench's npz format: both ways, memory-mapped, atomic, and whatever else comes from outside."""

import io
import os
import pickle
import struct
from types import SimpleNamespace
import zipfile

from hypothesis import given, settings
from hypothesis import strategies as st
from metagcttt_core import DatasetError, TrajectoryDataset
from metagcttt_core.data import npz
import numpy as np
import pytest
from tests.core.builders import random_dataset

FIELDS = ('observations', 'actions', 'terminals')
BOTH_WAYS = pytest.mark.parametrize('memory_map', [False, True])


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def npy_with_header(header: str, body: bytes = b'') -> bytes:
    encoded = header.encode() + b'\n'
    return b'\x93NUMPY\x01\x00' + struct.pack('<H', len(encoded)) + encoded + body


def write_members(path, **members: bytes) -> None:
    """An npz file with the given raw members, the required ones valid unless given."""
    valid = {
        'observations': npy(np.zeros((4, 2), np.float32)),
        'actions': npy(np.zeros((4, 2), np.float32)),
        'terminals': npy(np.array([0, 1, 0, 1], bool)),
    }
    with zipfile.ZipFile(path, 'w') as archive:
        for name, content in (valid | members).items():
            archive.writestr(f'{name}.npy', content)


def assert_same(dataset: TrajectoryDataset, other: TrajectoryDataset) -> None:
    for name in (*FIELDS, 'episode_starts', 'episode_ends'):
        ours, theirs = getattr(dataset, name), getattr(other, name)
        assert ours.dtype == theirs.dtype
        assert np.array_equal(ours, theirs), name
    assert dataset.extras.keys() == other.extras.keys()
    for name, values in dataset.extras.items():
        assert np.array_equal(values, other.extras[name]), name


@settings(max_examples=30)
@given(st.lists(st.integers(1, 5), min_size=1, max_size=6), st.integers(1, 4), st.booleans())
def test_save_then_load_gives_the_same_dataset(tmp_path_factory, lengths, obs_dim, memory_map):
    dataset = random_dataset(lengths, obs_dim=obs_dim)
    dataset.extras['qpos'] = np.arange(2.0 * dataset.num_rows).reshape(-1, 2)
    path = tmp_path_factory.mktemp('npz') / 'data.npz'
    dataset.save(path)
    loaded = TrajectoryDataset.load(path, memory_map=memory_map)
    assert_same(loaded, dataset)
    assert loaded.source == path


@BOTH_WAYS
def test_load_then_save_keeps_an_ogbench_file(tmp_path, memory_map):
    """OGBench's own files: float64 qpos, float terminals or booleans, compressed."""
    source = random_dataset([3, 1, 4], obs_dim=4)
    np.savez_compressed(
        tmp_path / 'ogbench.npz',
        observations=source.observations,
        actions=source.actions,
        terminals=source.terminals.astype(np.float32),
        qpos=np.ones((8, 3)),
        qvel=np.zeros((8, 2)),
    )
    TrajectoryDataset.load(tmp_path / 'ogbench.npz', memory_map=memory_map).save(
        tmp_path / 'ours.npz'
    )
    with np.load(tmp_path / 'ours.npz') as ours:
        assert sorted(ours) == ['actions', 'observations', 'qpos', 'qvel', 'terminals']
        assert np.array_equal(ours['observations'], source.observations)
        assert np.array_equal(ours['actions'], source.actions)
        assert np.array_equal(ours['terminals'], source.terminals)
        assert ours['terminals'].dtype == np.bool_
        assert ours['qpos'].dtype == np.float64


def test_stored_next_observations_are_left_out(tmp_path):
    write_members(tmp_path / 'data.npz', next_observations=npy(np.zeros((4, 2))))
    assert TrajectoryDataset.load(tmp_path / 'data.npz').extras == {}


def test_memory_mapped_rows_stay_on_disk(tmp_path):
    random_dataset().save(tmp_path / 'data.npz')
    mapped = TrajectoryDataset.load(tmp_path / 'data.npz', memory_map=True)
    assert isinstance(mapped.observations, np.memmap)
    assert isinstance(mapped.actions, np.memmap)
    in_memory = TrajectoryDataset.load(tmp_path / 'data.npz', memory_map=False)
    assert not isinstance(in_memory.observations, np.memmap)
    assert_same(mapped, in_memory)


def test_only_large_files_are_memory_mapped_by_default(tmp_path, monkeypatch):
    random_dataset().save(tmp_path / 'data.npz')
    assert not isinstance(TrajectoryDataset.load(tmp_path / 'data.npz').observations, np.memmap)
    monkeypatch.setattr(npz, 'MEMORY_MAP_BYTES', 100)
    assert isinstance(TrajectoryDataset.load(tmp_path / 'data.npz').observations, np.memmap)


def test_memory_map_is_renewed_when_the_file_changes(tmp_path):
    path = tmp_path / 'data.npz'
    first, second = random_dataset([4, 4], seed=1), random_dataset([4, 4], seed=2)
    first.save(path)
    before = path.stat()
    mapped = TrajectoryDataset.load(path, memory_map=True)
    second.save(path)
    # Nor is it hidden by the time.
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert_same(TrajectoryDataset.load(path, memory_map=True), second)
    assert np.array_equal(mapped.observations, first.observations)
    # The old rows take no room.
    assert sum(path.is_dir() for path in (tmp_path / 'data.unpacked').iterdir()) == 1


@pytest.mark.parametrize('linked', [False, True])
def test_memory_map_leaves_a_folder_of_that_name_alone(tmp_path, linked):
    path = tmp_path / 'data.npz'
    random_dataset().save(path)
    theirs = tmp_path / ('elsewhere' if linked else 'data.unpacked')
    (theirs / 'thesis').mkdir(parents=True)
    if linked:
        (tmp_path / 'data.unpacked').symlink_to(theirs, target_is_directory=True)
    with pytest.raises(DatasetError, match=r'data\.unpacked exists and was not made by metagcttt'):
        TrajectoryDataset.load(path, memory_map=True)
    assert (theirs / 'thesis').is_dir()


def test_memory_map_is_unpacked_once(tmp_path):
    path = tmp_path / 'data.npz'
    random_dataset().save(path)
    TrajectoryDataset.load(path, memory_map=True)
    unpacked = {file: file.stat().st_mtime_ns for file in tmp_path.rglob('*.npy')}
    assert {file.name for file in unpacked} == {f'{name}.npy' for name in FIELDS}
    TrajectoryDataset.load(path, memory_map=True)
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob('*.npy')} == unpacked


def test_interrupted_unpacking_is_finished(tmp_path):
    path = tmp_path / 'data.npz'
    dataset = random_dataset()
    dataset.save(path)
    TrajectoryDataset.load(path, memory_map=True)
    (actions,) = tmp_path.rglob('actions.npy')
    actions.write_bytes(actions.read_bytes()[:100])
    next(tmp_path.rglob('terminals.npy')).unlink()
    assert_same(TrajectoryDataset.load(path, memory_map=True), dataset)


@BOTH_WAYS
@pytest.mark.parametrize('missing', FIELDS)
def test_missing_key_is_refused_by_name(tmp_path, missing, memory_map):
    dataset = random_dataset()
    path = tmp_path / 'data.npz'
    np.savez(path, **{name: getattr(dataset, name) for name in FIELDS if name != missing})
    with pytest.raises(DatasetError, match=rf'data\.npz: missing {missing}; required: .*; found:'):
        TrajectoryDataset.load(path, memory_map=memory_map)


@BOTH_WAYS
@pytest.mark.parametrize('kept', [0, 1, 30, 0.25, 0.5, 0.75, 0.9, -1, -22])
def test_truncated_file_is_refused(tmp_path, kept, memory_map):
    path = tmp_path / 'data.npz'
    random_dataset([50, 50]).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if isinstance(kept, float) else kept])
    with pytest.raises(DatasetError, match=r'data\.npz: not a complete npz file'):
        TrajectoryDataset.load(path, memory_map=memory_map)


@pytest.mark.parametrize(
    ('flipped', 'memory_map', 'every'), [(0x01, False, 3), (0xFF, False, 3), (0xFF, True, 11)]
)
def test_damaged_byte_never_goes_unnoticed(tmp_path, flipped, memory_map, every):
    """Wherever one byte is wrong, the data is either intact or refused with the file's name."""
    path = tmp_path / 'data.npz'
    dataset = random_dataset([2, 2])
    dataset.save(path)
    content = path.read_bytes()
    refused = 0
    # The directory at the end says how to read the rest.
    directory = range(len(content) - 240, len(content), 1 if every < 10 else 5)
    for position in sorted({*range(0, len(content), every), *directory}):
        damaged = bytearray(content)
        damaged[position] ^= flipped
        path.write_bytes(damaged)
        try:
            loaded = TrajectoryDataset.load(path, memory_map=memory_map)
        except DatasetError as error:
            refused += 1
            assert 'data.npz' in str(error)
        else:
            for name in FIELDS:
                assert np.array_equal(getattr(loaded, name), getattr(dataset, name)), position
    assert refused > 30


@BOTH_WAYS
def test_pickled_array_is_refused_and_never_run(tmp_path, memory_map):
    class Trap:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / 'ran'),))

    path = tmp_path / 'data.npz'
    dataset = random_dataset()
    np.savez(
        path,
        observations=np.array([[Trap(), 1]] * 15, dtype=object),
        actions=dataset.actions,
        terminals=dataset.terminals,
    )
    with pytest.raises(DatasetError, match=r'data\.npz: observations cannot be read, it is pick'):
        TrajectoryDataset.load(path, memory_map=memory_map)
    assert not (tmp_path / 'ran').exists()


@BOTH_WAYS
@pytest.mark.parametrize(
    'member',
    [
        pickle.dumps([1, 2, 3]),
        b'',
        b'no array at all',
        npy_with_header("{'descr': '<f4', 'fortran_order': False, 'shape': (4, 2), }", b'short'),
        npy_with_header("{'descr': '<f4', 'fortran_order': False, 'shape': (-4, 2), }"),
        npy_with_header("{'descr': 'banana', 'fortran_order': False, 'shape': (4, 2), }"),
        npy_with_header("{'descr': '<f4', 'fortran_order': False, 'shape': ("),
        npy_with_header(f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({10**30}, 2), }}"),
        npy_with_header('-' * 9000 + '1'),
    ],
    ids=['pickle', 'empty', 'text', 'short', 'negative', 'dtype', 'open', 'overflow', 'nested'],
)
def test_member_that_is_no_array_is_refused_by_name(tmp_path, member, memory_map):
    path = tmp_path / 'data.npz'
    write_members(path, actions=member)
    with pytest.raises(DatasetError, match=r'data\.npz: actions '):
        TrajectoryDataset.load(path, memory_map=memory_map)


def test_array_larger_than_memory_is_refused_by_name(tmp_path):
    path = tmp_path / 'data.npz'
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({10**15}, 2), }}"
    write_members(path, actions=npy_with_header(header))
    for memory_map in (False, True):  # before anything is allocated
        with pytest.raises(DatasetError, match=r'data\.npz: actions is damaged.*does not take 0'):
            TrajectoryDataset.load(path, memory_map=memory_map)


@BOTH_WAYS
def test_sizes_that_the_directory_of_the_archive_announces_take_no_memory(
    tmp_path, memory_map, bounded_memory
):
    path, num_bytes = tmp_path / 'data.npz', 3 << 30
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({num_bytes // 4}, 1), }}"
    member = npy_with_header(header)
    write_members(path, actions=member)
    place = path.read_bytes().rindex(b'actions.npy') - 46 + 24  # uncompressed size, central
    content = bytearray(path.read_bytes())
    content[place : place + 4] = (num_bytes + len(member)).to_bytes(4, 'little')
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=r'data\.npz: actions announces 322122'):
        TrajectoryDataset.load(path, memory_map=memory_map)


@BOTH_WAYS
def test_header_of_any_size_takes_no_memory(tmp_path, memory_map, bounded_memory):
    path, size = tmp_path / 'data.npz', 64 << 20
    write_members(path)
    member = b'\x93NUMPY\x02\x00' + size.to_bytes(4, 'little') + bytes(size)
    with zipfile.ZipFile(path, 'a', zipfile.ZIP_DEFLATED) as archive:
        archive.writestr('extra.npy', member)
    with pytest.raises(DatasetError, match=r'data\.npz: extra cannot be read'):
        TrajectoryDataset.load(path, memory_map=memory_map)


def test_other_compression_is_refused(tmp_path):
    write_members(tmp_path / 'data.npz')
    with zipfile.ZipFile(tmp_path / 'data.npz', 'a', zipfile.ZIP_BZIP2) as archive:
        archive.writestr('extra.npy', npy(np.zeros(4)))
    with pytest.raises(DatasetError, match='extra is compressed by another method than deflate'):
        TrajectoryDataset.load(tmp_path / 'data.npz')


@pytest.mark.parametrize('memory_map', [False, True])
def test_what_this_machine_cannot_hold_is_refused(tmp_path, memory_map, monkeypatch):
    write_members(tmp_path / 'data.npz')
    monkeypatch.setattr('os.sysconf', lambda name: 5)
    monkeypatch.setattr('shutil.disk_usage', lambda path: SimpleNamespace(free=25))
    with pytest.raises(DatasetError, match='25 are free' if memory_map else 'machine has 25'):
        TrajectoryDataset.load(tmp_path / 'data.npz', memory_map=memory_map)


@BOTH_WAYS
@pytest.mark.parametrize('name', ['../outside', 'inner/outside', '{tmp}/outside'])
def test_member_outside_the_archive_is_refused(tmp_path, name, memory_map):
    name = name.format(tmp=tmp_path)
    path = tmp_path / 'inner' / 'data.npz'
    path.parent.mkdir()
    write_members(path, **{name: npy(np.zeros(4))})
    with pytest.raises(DatasetError, match=rf"data\.npz: '{name}' is not a plain array name"):
        TrajectoryDataset.load(path, memory_map=memory_map)
    assert not list(tmp_path.rglob('outside*'))


@BOTH_WAYS
def test_wrong_content_is_refused_with_file_field_and_row(tmp_path, memory_map):
    path = tmp_path / 'data.npz'
    actions = np.zeros((4, 2), np.float32)
    actions[2, 1] = np.nan
    write_members(path, actions=npy(actions))
    with pytest.raises(DatasetError, match=rf'^{path}: actions is nan in row 2; '):
        TrajectoryDataset.load(path, memory_map=memory_map)


@BOTH_WAYS
@pytest.mark.parametrize(
    ('members', 'message'),
    [
        ({'observations': npy(np.zeros((4, 2, 1)))}, r'observations must have shape'),
        ({'actions': npy(np.zeros((3, 2)))}, 'actions has 3 rows but observations has 4'),
        ({'terminals': npy(np.array([0, 1, 0, 0.0]))}, 'terminals is false on the last row'),
        ({'terminals': npy(np.array([0, 0.5, 0, 1]))}, 'terminals must hold 0 or 1, got 0.5'),
        ({'timeouts': npy(np.zeros(9))}, 'timeouts has 9 rows but terminals has 4'),
        ({'timeouts': npy(np.array([1, 3]))}, 'timeouts must hold 0 or 1, got 3 in row 1'),
        ({'traj_id': npy(np.zeros(4))}, 'traj_id looks like a mark of trajectories'),
        ({'episode_starts': npy(np.arange(2))}, 'episode_starts looks like a mark'),
    ],
)
def test_wrong_arrays_are_refused_with_the_file(tmp_path, members, message, memory_map):
    write_members(tmp_path / 'data.npz', **members)
    with pytest.raises(DatasetError, match=rf'data\.npz: {message}'):
        TrajectoryDataset.load(tmp_path / 'data.npz', memory_map=memory_map)


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(DatasetError, match=r'absent\.npz: no such file'):
        TrajectoryDataset.load(tmp_path / 'absent.npz')
    with pytest.raises(
        DatasetError, match=rf'{tmp_path}: no Minari dataset there, expected .*main_data\.hdf5'
    ):
        TrajectoryDataset.load(tmp_path)


def test_failing_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / 'data.npz'
    old = random_dataset(seed=1)
    old.save(path)

    def fail_halfway(file, **arrays):
        file.write(b'half of the new fi')
        raise OSError('no space left on device')

    monkeypatch.setattr(np, 'savez_compressed', fail_halfway)
    with pytest.raises(OSError, match='no space left'):
        random_dataset(seed=2).save(path)
    assert [file.name for file in tmp_path.iterdir()] == ['data.npz']
    assert_same(TrajectoryDataset.load(path), old)


def test_save_makes_missing_folders(tmp_path):
    path = tmp_path / 'a' / 'b' / 'data.npz'
    random_dataset().save(path)
    assert TrajectoryDataset.load(path).num_rows == 15


@pytest.mark.parametrize(
    ('obs_dim', 'act_dim', 'nq', 'nv'), [(2, 2, 2, 2), (29, 8, 15, 14), (69, 21, 28, 27)]
)
@pytest.mark.parametrize('floats', [np.float16, np.float32])
@pytest.mark.parametrize('flags', [bool, np.float32, np.uint8])
def test_files_as_ogbench_publishes_them_load_unchanged(
    tmp_path, obs_dim, act_dim, nq, nv, floats, flags
):
    rng, rows = np.random.default_rng(0), 33
    terminals = np.arange(rows) % 11 == 10
    arrays = {
        name: rng.normal(size=(rows, width)).astype(floats)
        for name, width in (
            ('observations', obs_dim),
            ('actions', act_dim),
            ('qpos', nq),
            ('qvel', nv),
        )
    }
    np.savez_compressed(tmp_path / 'maze.npz', **arrays, terminals=terminals.astype(flags))
    dataset = TrajectoryDataset.load(tmp_path / 'maze.npz')
    for name in ('observations', 'actions'):
        array = getattr(dataset, name)
        assert array.dtype == np.float32
        np.testing.assert_array_equal(array, arrays[name])
    for name in ('qpos', 'qvel'):
        np.testing.assert_array_equal(dataset.extras[name], arrays[name])
    np.testing.assert_array_equal(dataset.episode_starts, [0, 11, 22])
    np.testing.assert_array_equal(dataset.episode_ends, [10, 21, 32])
