"""Minari datasets: written by Minari's own API, read as rows; and what is refused."""

from pathlib import Path
import re
import sys
from typing import Any

from gymnasium import spaces
import h5py
from metagcttt_core import DatasetError, TrajectoryDataset
import minari
from minari.data_collector import EpisodeBuffer
import numpy as np
import pytest

pytestmark = [
    pytest.mark.filterwarnings('ignore:.* is set to None'),
    pytest.mark.filterwarnings('ignore:env_spec is None'),
]
LENGTHS = [4, 2, 11, 3, 5, 6, 7, 8, 9, 2, 3, 4]  # 12 episodes: '10' sorts before '2' as text


def episode(number, steps, *, robot):
    rng = np.random.default_rng(number)
    position = rng.normal(size=(steps + 1, 2))
    rest = rng.normal(size=(steps + 1, 2 if robot == 'point' else 27))
    observation = np.concatenate([position, rest], axis=1) if robot == 'point' else rest
    return EpisodeBuffer(
        id=number,
        observations={
            'observation': observation,
            'achieved_goal': position,
            'desired_goal': rng.normal(size=(steps + 1, 2)),
        },
        actions=rng.uniform(-1, 1, (steps, 2)).astype(np.float32),
        rewards=[0.0] * steps,
        terminations=[False] * steps,
        truncations=[False] * (steps - 1) + [True],
        infos={'qpos': position} if robot == 'point' else {},
    )


@pytest.fixture(params=['point', 'ant'])
def made(request, tmp_path, monkeypatch):
    """The episodes and the folder of a dataset that Minari wrote."""
    monkeypatch.setenv('MINARI_DATASETS_PATH', str(tmp_path))
    episodes = [episode(k, steps, robot=request.param) for k, steps in enumerate(LENGTHS)]
    box = {name: spaces.Box(-np.inf, np.inf, value.shape[1:], np.float64) for name, value in
           episodes[0].observations.items()}  # fmt: skip
    minari.create_dataset_from_buffers(
        'maze/walks-v0',
        episodes,
        observation_space=spaces.Dict(box),
        action_space=spaces.Box(-1, 1, (2,)),
        algorithm_name='random',
        author='nobody',
        author_email='nobody@example.org',
        code_permalink='https://example.org',
    )
    return episodes, tmp_path / 'maze' / 'walks-v0'


def test_rows_are_the_episodes_back_to_back(made):
    episodes, folder = made
    dataset = TrajectoryDataset.load(folder)
    assert dataset.num_episodes == len(LENGTHS)
    assert (dataset.observations.dtype, dataset.source) == (np.float32, folder)
    for first, last, expected in zip(
        dataset.episode_starts, dataset.episode_ends, episodes, strict=True
    ):
        observations = expected.observations
        rows = (
            observations['observation']
            if dataset.obs_dim == 4
            else np.hstack([observations['achieved_goal'], observations['observation']])
        )
        np.testing.assert_allclose(dataset.observations[first : last + 1], rows, rtol=1e-6)
        np.testing.assert_array_equal(dataset.actions[first:last], expected.actions)
        np.testing.assert_array_equal(dataset.actions[last], 0)
    assert dataset.obs_dim in (4, 29)
    assert set(dataset.extras) == ({'qpos'} if dataset.obs_dim == 4 else set())


def test_file_data_folder_and_dataset_folder_are_the_same_dataset(made):
    _, folder = made
    paths = (folder, folder / 'data', folder / 'data' / 'main_data.hdf5')
    first, *others = [TrajectoryDataset.load(path) for path in paths]
    for other in others:
        np.testing.assert_array_equal(first.observations, other.observations)
        np.testing.assert_array_equal(first.terminals, other.terminals)


def test_imported_dataset_can_be_saved_as_npz(made, tmp_path):
    dataset = TrajectoryDataset.load(made[1])
    dataset.save(tmp_path / 'walks.npz')
    again = TrajectoryDataset.load(tmp_path / 'walks.npz')
    np.testing.assert_array_equal(dataset.observations, again.observations)
    np.testing.assert_array_equal(dataset.episode_ends, again.episode_ends)


def write(path, **episodes):
    with h5py.File(path, 'w') as file:
        for name, fields in episodes.items():
            for field, values in fields.items():
                file[f'{name}/{field}'] = values
    return path


def test_plain_arrays_are_taken_as_they_are(tmp_path):
    states = np.arange(12.0).reshape(4, 3)
    path = write(
        tmp_path / 'a.hdf5', episode_0={'observations': states, 'actions': np.ones((3, 1))}
    )
    dataset = TrajectoryDataset.load(path)
    np.testing.assert_array_equal(dataset.observations, states)
    np.testing.assert_array_equal(dataset.actions[:, 0], [1, 1, 1, 0])
    np.testing.assert_array_equal(dataset.terminals, [False, False, False, True])


GOOD = {'observations': np.zeros((4, 3)), 'actions': np.zeros((3, 1))}


@pytest.mark.parametrize(
    ('episodes', 'message'),
    [
        ({}, 'holds no episodes'),
        ({'episode_0': {'observations': np.zeros((4, 3))}}, 'episode_0 has no actions'),
        (
            {'episode_0': {**GOOD, 'actions': np.zeros((4, 1))}},
            'episode_0 has 4 actions but 4 observations, expected 5',
        ),
        (
            {'episode_0': GOOD, 'episode_1': {**GOOD, 'observations': np.zeros((4, 2))}},
            r"episode 1 has fields .*'observations': \(2,\).* the first one has",
        ),
        ({'episode_0': {**GOOD, 'actions': [b'x', b'y', b'z']}}, 'actions must be numbers'),
        ({'episode_0': {**GOOD, 'actions': np.zeros(3)}}, r'got float64 of shape \(3,\)'),
        (
            {'episode_0': {'observations/observation': np.zeros((4, 3)), 'actions': [[0]] * 3}},
            'must hold observation and achieved_goal, found: observation',
        ),
        ({'episode_0': {**GOOD, 'observations': np.full((4, 3), np.nan)}}, 'nan in row 0'),
    ],
)
def test_wrong_content_is_refused(tmp_path, episodes, message):
    with pytest.raises(DatasetError, match=message):
        TrajectoryDataset.load(write(tmp_path / 'bad.hdf5', **episodes))


def test_truncated_and_missing_files_are_refused(tmp_path):
    path = write(tmp_path / 'cut.hdf5', episode_0=GOOD)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(DatasetError, match=r'cut\.hdf5: not a complete HDF5 file'):
        TrajectoryDataset.load(path)
    with pytest.raises(DatasetError, match=r'absent\.hdf5: no such file'):
        TrajectoryDataset.load(tmp_path / 'absent.hdf5')


def test_without_h5py_the_message_says_what_to_install(tmp_path, monkeypatch):
    write(tmp_path / 'a.hdf5', episode_0=GOOD)
    monkeypatch.setitem(sys.modules, 'h5py', None)
    with pytest.raises(DatasetError, match=r'pip install "metagcttt-core\[minari\]"'):
        TrajectoryDataset.load(tmp_path / 'a.hdf5')


def point_episode(file, number):
    group = file.create_group(f'episode_{number}')
    observations = group.create_group('observations')
    observations['observation'] = np.random.default_rng(number).normal(size=(6, 4))
    observations['achieved_goal'] = observations['observation'][:, :2]
    group['actions'] = np.zeros((5, 2))
    return group


@pytest.fixture
def two_episodes(tmp_path):
    with h5py.File(tmp_path / 'main_data.hdf5', 'w') as file:
        for number in range(2):
            point_episode(file, number)
        yield file


def loaded(file):
    path = file.filename
    file.close()
    return TrajectoryDataset.load(path)


def test_achieved_goal_in_single_precision_is_found_in_the_observation(two_episodes):
    for group in two_episodes.values():
        positions = group['observations/achieved_goal'][()].astype(np.float32)
        del group['observations/achieved_goal']
        group['observations/achieved_goal'] = positions
    assert loaded(two_episodes).obs_dim == 4


def test_infos_that_nobody_needs_are_left_out(two_episodes):
    for number in range(2):
        infos = two_episodes[f'episode_{number}'].create_group('infos')
        infos['qpos'] = np.zeros((5, 2))  # T rows, not T + 1
        infos['success'] = np.zeros(5, bool)
    dataset = loaded(two_episodes)
    assert (dataset.num_episodes, dataset.extras) == (2, {})


@pytest.mark.parametrize(
    'infos',
    [np.zeros(3), h5py.ExternalLink('elsewhere.hdf5', '/x'), h5py.SoftLink('/nowhere')],
    ids=['array', 'external', 'soft'],
)
def test_infos_that_are_no_group_are_left_out(two_episodes, infos):
    two_episodes['episode_1/infos'] = infos
    two_episodes['episode_0/infos/qpos'] = np.array([b'text'] * 6)
    assert loaded(two_episodes).extras == {}


def test_infos_of_some_episodes_only_are_left_out(two_episodes):
    two_episodes['episode_0/infos/qpos'] = np.zeros((6, 2))
    for number in range(2):
        two_episodes[f'episode_{number}/infos/qvel'] = np.ones((6, 3))
    assert {name: array.shape for name, array in loaded(two_episodes).extras.items()} == {
        'qvel': (12, 3)
    }


def external(file):
    file['episode_2'] = h5py.ExternalLink('not-copied-along.hdf5', '/episode_0')


def soft(file):
    file['episode_2'] = h5py.SoftLink('/episode_0')


def array(file):
    file['episode_2'] = np.zeros(3)


def gap(file):
    point_episode(file, 3)


def bomb(file):
    del file['episode_1/actions']
    file['episode_1'].create_dataset('actions', (10**12, 2), 'f8', chunks=(1000, 2))


def unwritten(file):
    del file['episode_1/actions']
    file['episode_1'].create_dataset('actions', (5, 2), 'f8')


def large_chunks(file):
    del file['episode_1/actions']
    options = {'chunks': (1 << 23, 2), 'maxshape': (None, 2), 'compression': 'gzip'}
    file['episode_1'].create_dataset('actions', (5, 2), 'f8', **options)
    file['episode_1/actions'][:] = 1


def far_number(file):
    point_episode(file, 10**12)


def two_in_one(file):
    file['episode_1/truncations'] = [False, True, False, False, True]


def text_as_mark(file):
    file['episode_1/dones'] = 'yes'


@pytest.mark.parametrize(
    ('oddity', 'message'),
    [
        (external, 'episode_2 is a link, which is not followed'),
        (soft, 'episode_2 is a link, which is not followed'),
        (array, 'episode_2 must be a group, got an array'),
        (gap, 'episode 2 is missing of 4'),
        (far_number, 'episode 2 is missing of 1000000000001'),
        (bomb, 'episode_1/actions announces 16000000000000 bytes, more than can be in the 0'),
        (unwritten, 'episode_1/actions announces 80 bytes, more than can be in the 0 stored'),
        (two_in_one, 'episode_1 ends after transition 1 by its truncations, but has 5'),
        (text_as_mark, 'episode_1/dones must be a flag for each step'),
        (large_chunks, 'episode_1/actions holds 80 bytes in chunks of 134217728'),
    ],
)
def test_odd_episode_is_refused_by_name(two_episodes, oddity, message):
    oddity(two_episodes)
    with pytest.raises(DatasetError, match=rf'main_data\.hdf5: .*{message}'):
        loaded(two_episodes)


def d4rl(path: Path, **changes: Any) -> Path:
    """A file in D4RL's layout: a goal that was reached, then a time-out."""
    rng = np.random.default_rng(0)
    arrays = {
        'observations': rng.normal(size=(9, 4)).astype(np.float32),
        'actions': rng.uniform(-1, 1, (9, 2)).astype(np.float32),
        'rewards': np.zeros(9, np.float32),
        'terminals': np.arange(9) == 3,
        'timeouts': np.arange(9) == 8,
        'infos/qpos': rng.normal(size=(9, 2)),
        **changes,
    }
    with h5py.File(path, 'w') as file:
        for name, array in arrays.items():
            if array is not None:
                file[name] = array
    return path


def test_d4rl_file_ends_trajectories_by_terminals_and_timeouts(tmp_path):
    dataset = TrajectoryDataset.load(d4rl(tmp_path / 'maze2d.hdf5'))
    assert dataset.episode_ends.tolist() == [3, 8]
    assert dataset.extras['qpos'].shape == (9, 2)
    assert sorted(dataset.extras) == ['qpos']


@pytest.mark.parametrize(
    ('changes', 'error'),
    [
        ({'timeouts': None}, 'terminals is false on the last row'),
        ({'terminals': None}, 'has no terminals; found: actions, infos, observations'),
        ({'timeouts': np.zeros(8, bool)}, 'timeouts must have a value for each row'),
        ({'timeouts': np.full(9, 2)}, 'timeouts must hold 0 or 1'),
        ({'is_last': np.zeros(9, bool)}, 'is_last looks like a mark of trajectories'),
        ({'infos/episode_id': np.zeros(9)}, 'episode_id looks like a mark of trajectories'),
        ({'infos/run': np.arange(9) // 6}, 'run looks like a mark of trajectories'),
        ({'lengths': np.array([5, 4])}, 'lengths divides the rows at other places'),
        ({'infos/time': np.arange(9) % 6}, 'time starts again after row 5'),
        ({'next_obs': np.ones((9, 4))}, 'next_obs of row 0 is not observation 1'),
        ({'actions': np.zeros((8, 2))}, 'actions has 8 rows but observations has 9'),
        ({'actions': np.zeros(9)}, 'actions must be numbers of shape'),
    ],
)
def test_d4rl_file_that_does_not_fit_is_named(tmp_path, changes, error):
    path = d4rl(tmp_path / 'maze2d.hdf5', **changes)
    with pytest.raises(DatasetError, match=f'maze2d.hdf5: .*{re.escape(error)}'):
        TrajectoryDataset.load(path)
