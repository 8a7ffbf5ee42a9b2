"""What a file says about its trajectories is used or refused; what looks wrong is logged."""

import logging
import re

from metagcttt_core import DatasetError, TrajectoryDataset
from metagcttt_core.data.marks import END_MARKS
import numpy as np
import pytest


def walk(rows=60, seed=0, start=0.0):
    """A bounded random walk and its actions."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (rows, 2)).astype(np.float32)
    steps = np.vstack([np.full((1, 2), start, np.float32), 0.2 * actions[:-1]])
    return {'observations': steps.cumsum(axis=0), 'actions': actions}


def two_walks():
    """Observations of walks from different places, one behind the other."""
    return np.vstack([walk(30)['observations'], walk(30, start=9)['observations']])


def flags(*rows, total=60):
    return np.isin(np.arange(total), rows)


def saved(tmp_path, **arrays):
    path = tmp_path / 'data.npz'
    np.savez(path, **{**walk(), 'terminals': flags(59), **arrays})
    return path


@pytest.mark.parametrize('name', END_MARKS)
@pytest.mark.parametrize('dtype', [bool, np.float32, np.int64])
def test_trajectories_end_at_every_mark(tmp_path, name, dtype):
    dataset = TrajectoryDataset.load(saved(tmp_path, **{name: flags(9, 29).astype(dtype)}))
    assert dataset.episode_ends.tolist() == [9, 29, 59]
    assert name not in dataset.extras


@pytest.mark.parametrize(
    ('name', 'array'),
    [
        ('is_first', flags(0, 30)),
        ('episode_id', np.arange(60) // 30),
        ('episode_starts', np.array([0, 30])),
        ('traj_lengths', np.array([30, 30])),
        ('masks', 1.0 - flags(29, 59)),
        ('discounts', np.where(flags(29, 59), 0.0, 0.99)),
        ('step_type', np.where(flags(29, 59), 2, 1)),
        ('timesteps', np.arange(60) % 30),
        ('runId', np.array(['a', 'b']).repeat(30)),
        ('valids', (1 - flags(29, 59))[:, None]),
        ('continues', ~flags(29, 59)),
        ('absorbing', flags(29, 59)),
        ('worker', np.arange(60) // 30),
    ],
)
def test_unknown_mark_is_refused_by_name(tmp_path, name, array):
    with pytest.raises(DatasetError, match=rf'data\.npz: {name} looks like a mark of trajector'):
        TrajectoryDataset.load(saved(tmp_path, **{name: array}))


@pytest.mark.parametrize(
    ('name', 'array'),
    [
        ('run_id', np.arange(60) // 30),
        ('masks', 1.0 - flags(29, 59)),
        ('timesteps', np.arange(60) % 30),
        ('step_type', np.repeat([[0, *[1] * 28, 2]], 2, axis=0).reshape(-1)),
        ('runId', np.array(['a', 'b']).repeat(30)),
    ],
)
def test_mark_that_tells_nothing_new_is_left_out(tmp_path, name, array):
    path = saved(tmp_path, timeouts=flags(29), **{name: array})
    dataset = TrajectoryDataset.load(path)
    assert (dataset.episode_ends.tolist(), dataset.extras) == ([29, 59], {})


@pytest.mark.parametrize(
    ('name', 'values'),
    [
        ('lengths', [30, 30]),
        ('num_rows_of_each', [20, 40]),
        ('splits', [0, 30, 60]),
        ('offsets', [0, 30]),
        ('last_of_each', [29, 59]),
    ],
)
def test_lengths_and_bounds_of_other_trajectories_are_refused(tmp_path, name, values):
    path = saved(tmp_path, **{name: np.array(values)})
    with pytest.raises(DatasetError, match=rf'data\.npz: {name} (divides the rows|looks like)'):
        TrajectoryDataset.load(path)


@pytest.mark.parametrize('values', [[30, 30], [0, 30, 60], [29, 59], [30, 60]])
def test_lengths_and_bounds_of_the_same_trajectories_are_left_out(tmp_path, values):
    path = saved(tmp_path, timeouts=flags(29), lengths=np.array(values))
    dataset = TrajectoryDataset.load(path)
    assert (dataset.episode_ends.tolist(), dataset.extras) == ([29, 59], {})


@pytest.mark.parametrize(
    ('name', 'values'),
    [
        ('time', 0.1 * (np.arange(60) % 30) + np.random.default_rng(0).uniform(0, 0.01, 60)),
        ('wall_clock', 10.0 - np.arange(60)),
        ('counted', np.arange(60) % 30),
    ],
)
def test_time_that_starts_again_is_refused_where_no_trajectory_ends(tmp_path, name, values):
    with pytest.raises(DatasetError, match=f'{name} starts again after row (29|0)'):
        TrajectoryDataset.load(saved(tmp_path, **{name: values}))


def test_time_that_starts_again_with_each_trajectory_is_kept(tmp_path):
    times = {'time': 0.1 * (np.arange(60) % 30), 'yaw': np.arange(60) % 30 - 15.0}
    dataset = TrajectoryDataset.load(saved(tmp_path, timeouts=flags(29), **times))
    assert set(dataset.extras) == {'time', 'yaw'}


def test_several_numbers_a_row_are_no_mark(tmp_path):
    dataset = TrajectoryDataset.load(saved(tmp_path, end_effector=walk()['observations']))
    assert set(dataset.extras) == {'end_effector'}


def test_what_nothing_needs_is_left_out_where_it_has_gaps(tmp_path, caplog):
    rewards = np.zeros(20, np.float32)
    rewards[3] = np.nan
    rows = {'observations': np.zeros((20, 2)), 'actions': np.zeros((20, 1))}
    marks = {'terminals': np.arange(20) % 10 == 9}
    np.savez(
        tmp_path / 'walk.npz', **rows, **marks, rewards=rewards, costs=rewards[4:5].repeat(20)
    )
    with caplog.at_level(logging.WARNING):
        dataset = TrajectoryDataset.load(tmp_path / 'walk.npz')
    assert set(dataset.extras) == {'costs'}
    assert 'walk.npz: rewards is left out, it is nan in row 3' in caplog.text


def test_jumps_of_short_trajectories_are_logged(tmp_path, caplog):
    rows = np.vstack([walk(12, seed, 9.0 * seed)['observations'] for seed in range(5)])
    with caplog.at_level(logging.WARNING):
        TrajectoryDataset.load(saved(tmp_path, observations=rows))
    assert 'jump by 9' in caplog.text


def test_what_is_no_row_of_numbers_is_left_out(tmp_path):
    path = saved(
        tmp_path,
        num_episodes=np.array(1),
        env_name=np.array('maze'),
        metadata=np.arange(3),
        names=np.array(['a'] * 60),
        qpos=np.zeros((60, 3)),
    )
    assert set(TrajectoryDataset.load(path).extras) == {'qpos'}


def test_next_observations_in_the_order_of_rows_are_left_out(tmp_path):
    observations = walk()['observations']
    following = np.vstack([observations[1:], observations[:1]])
    following[29] = 7.0  # the end of a trajectory may lead anywhere
    path = saved(tmp_path, next_observations=following, timeouts=flags(29))
    assert TrajectoryDataset.load(path).extras == {}


def test_next_observations_in_another_order_are_refused(tmp_path):
    order = np.random.default_rng(1).permutation(60)
    rows = walk()
    following = np.vstack([rows['observations'][1:], rows['observations'][-1:]])
    shuffled = {name: array[order] for name, array in rows.items()}
    for name in ('next_observations', 'next_obs', 'observations_next', 'next_state', 'obs2'):
        path = saved(tmp_path, **shuffled, **{name: following[order]})
        with pytest.raises(DatasetError, match=f'{name} of row 0 is not observation 1'):
            TrajectoryDataset.load(path)
    path = saved(tmp_path, next_observations=following[:, :1])
    with pytest.raises(DatasetError, match=r'next_observations has shape \(60, 1\)'):
        TrajectoryDataset.load(path)


@pytest.mark.parametrize(
    ('arrays', 'told'),
    [
        ({'actions': 3 * walk()['actions']}, ['actions reach 2.9', 'scales them']),
        (
            {'observations': two_walks()},
            ['from row 29 to the next', 'jump by'],
        ),
    ],
    ids=['actions', 'jump'],
)
def test_suspicious_content_is_logged(tmp_path, arrays, told, caplog):
    with caplog.at_level(logging.WARNING):
        TrajectoryDataset.load(saved(tmp_path, **arrays))
    (line,) = [record.getMessage() for record in caplog.records]
    assert str(tmp_path / 'data.npz') in line
    assert all(part in line for part in told), line


def test_ordinary_content_is_not_remarked_upon(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        TrajectoryDataset.load(saved(tmp_path, timeouts=flags(29)))
        TrajectoryDataset.load(saved(tmp_path, timeouts=flags(29), observations=two_walks()))
    assert caplog.records == []


@pytest.mark.parametrize('name', ['observations', 'actions'])
@pytest.mark.parametrize('value', [3e38, -2e15])
def test_numbers_beyond_all_units_are_refused_by_row(tmp_path, name, value):
    rows = walk()[name]
    rows[7, 1] = value
    told = re.escape(f'{name} is {value:.3g} in row 7; every value must be within 1e+15')
    with pytest.raises(DatasetError, match=told):
        TrajectoryDataset.load(saved(tmp_path, **{name: rows}))


def test_masked_values_are_refused_by_row():
    rows = walk()
    rows['observations'] = np.ma.masked_array(rows['observations'], rows['actions'] == 2)
    assert type(TrajectoryDataset.from_arrays(**rows, terminals=flags(59)).observations) is (
        np.ndarray
    )
    rows['observations'][5, 0] = np.ma.masked
    with pytest.raises(DatasetError, match='observations is masked in row 5'):
        TrajectoryDataset.from_arrays(**rows, terminals=flags(59))


def test_actions_far_below_their_range_are_logged(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        TrajectoryDataset.load(saved(tmp_path, actions=1e-30 * walk()['actions']))
    assert 'data.npz: actions reach only 9.' in caplog.text
    caplog.clear()
    TrajectoryDataset.load(saved(tmp_path, actions=0 * walk()['actions']))
    assert caplog.records == []


@pytest.mark.parametrize('dtype', [np.int64, np.int32, np.longdouble])
def test_far_whole_numbers_are_counted_from_an_origin(tmp_path, dtype):
    millimetres = (500_000_000 + np.round(1000 * walk()['observations'])).astype(dtype)
    dataset = TrajectoryDataset.load(saved(tmp_path, observations=millimetres))
    assert np.array_equal(dataset.states(slice(None)), millimetres)


def test_far_robot_that_mostly_stands_keeps_its_precision(tmp_path):
    standing = 5e6 + np.repeat(walk()['observations'].astype(np.float64), 3, axis=0)
    rows = {'actions': np.zeros((180, 2)), 'terminals': flags(179, total=180)}
    dataset = TrajectoryDataset.load(saved(tmp_path, observations=standing, **rows))
    assert np.abs(dataset.states(slice(None)) - standing).max() < 1e-6


def test_coordinates_that_single_precision_has_rounded_are_logged(tmp_path, caplog):
    far = (5e6 + walk()['observations']).astype(np.float32)
    with caplog.at_level(logging.WARNING):
        TrajectoryDataset.load(saved(tmp_path, observations=far))
    assert 'observations[:, 0] is stored in steps of 0.5, where it moves by 0.5' in caplog.text
