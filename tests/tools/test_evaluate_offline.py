"""Policies without a simulator: figures, ranking, and agreement with success in simulation."""

import json
from pathlib import Path

from metagcttt_core import save_checkpoint, TrajectoryDataset
from metagcttt_core.training.config import PretrainConfig
from metagcttt_core.training.pretrain import pretrain
from metagcttt_tools.evaluate_offline import correlation, spearman
from metagcttt_tools.main import main
import numpy as np
import pytest
import scipy.stats
from tests.core.builders import maze_walks, random_dataset, tiny_agent


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Walks with the way to the next state as actions; a policy before and after training."""
    folder = tmp_path_factory.mktemp('offline')
    walks = maze_walks()
    actions = np.vstack([np.diff(walks.observations, axis=0), np.zeros((1, 2))])
    data = TrajectoryDataset.from_arrays(
        walks.observations, np.clip(0.5 * actions, -1, 1), walks.terminals
    )
    data.save(folder / 'walks.npz')
    fresh = tiny_agent(hidden=(32,))
    save_checkpoint(fresh, folder / 'fresh')
    trained = pretrain(fresh, data, PretrainConfig(steps=300, batch_size=64, lr=1e-2), 0)
    save_checkpoint(trained, folder / 'trained')
    return folder


def evaluate(folder: Path, out: Path, *more: str) -> dict:
    policies = [str(folder / 'fresh'), str(folder / 'trained')]
    main(
        [
            *('evaluate', '--offline', '--dataset', str(folder / 'walks.npz')),
            *('--checkpoints', *policies, '--budgets', '0', '5', '--steps-ahead', '5', '20'),
            *('--ttt.batch-size', '32', '--trajectories', '6', '--processes', '1'),
            *('--held-out-share', '0.3', '--out', str(out), *more),
        ]
    )
    return json.loads(out.read_text())


def test_figures_tell_the_better_policy(folder, tmp_path, capsys):
    report = evaluate(folder, tmp_path / 'offline.json', '--filter.epsilon', '4')
    text = capsys.readouterr().out
    assert '12 queries from 12 trajectories of' in text
    assert 'policies trained on that file have seen them' in text
    figures = {(Path(r['checkpoint']).name, r['budget']): r for r in report['results']}
    assert len(figures) == 4
    fresh, trained = figures['fresh', 0], figures['trained', 0]
    assert trained['error']['mean'] < fresh['error']['mean']
    assert trained['log_likelihood']['mean'] > fresh['log_likelihood']['mean']
    for row in figures.values():
        assert row['error']['low'] < row['error']['mean'] < row['error']['high']
        assert row['by_distance'].keys() == {'5', '20'}
        assert row['empty'] < 0.2
    change = figures['fresh', 5]['error_change']
    difference = figures['fresh', 5]['error']['mean'] - fresh['error']['mean']
    assert change['mean'] == pytest.approx(difference)
    assert fresh['error_change']['low'] == fresh['error_change']['high'] == 0
    assert (tmp_path / 'offline.png').read_bytes().startswith(b'\x89PNG')


def test_contract_of_the_data_decides_about_distances(folder, tmp_path):
    data = TrajectoryDataset.load(folder / 'walks.npz')
    data.contract = {'robot': 'cart', 'position_dims': [1], 'epsilon': 0.5}
    data.save(tmp_path / 'robot.npz')
    robot = evaluate(folder, tmp_path / 'a.json', '--dataset', str(tmp_path / 'robot.npz'))
    assert {row['epsilon'] for row in robot['results']} == {0.5}
    flags = ('--filter.epsilon', '0.5', '--filter.position-dims', '1')
    same = evaluate(folder, tmp_path / 'b.json', *flags)
    assert same['results'] == robot['results']
    usual = evaluate(folder, tmp_path / 'c.json')
    assert {row['epsilon'] for row in usual['results']} == {1.0}
    assert usual['results'][1]['support'] != robot['results'][1]['support']


def test_grid_ranks_all_settings(folder, tmp_path, capsys):
    grid = ('--grid', '--epsilons', '0.001', '4', '--lrs', '0.001', '0.01')
    report = evaluate(folder, tmp_path / 'offline.json', *grid)
    assert len(report['results']) == 16
    table = [line.split('|') for line in capsys.readouterr().out.splitlines() if '|' in line][2:]
    errors = [float(row[6].split()[0]) for row in table]
    assert len(errors) == 16
    assert errors == sorted(errors)
    empty = {row['epsilon']: row['empty'] for row in report['results']}
    assert empty[0.001] == 1 > 0.2 > empty[4]


def test_what_does_not_fit_is_refused(folder, tmp_path, capsys):
    random_dataset(obs_dim=3).save(tmp_path / 'other.npz')
    other = str(tmp_path / 'other.npz')
    (tmp_path / 'none.json').write_text('{"settings": {}}')
    for more, error in (
        (('--held-out', other), 'other.npz: observations or actions differ in width'),
        (('--held-out', 'none.npz'), 'none.npz: no such file'),
        (
            ('--dataset', other),
            f'is for observations of 2 and actions of 2 values, the dataset {other} has 3',
        ),
        (('--against', str(tmp_path / 'none.json')), 'none.json: no results of metagcttt evaluat'),
        (('--steps-ahead', '500'), 'the longest held-out trajectory has 100 transitions'),
        (('--budgets', '5', '0'), 'must ascend from 0 or more'),
    ):
        with pytest.raises(SystemExit, match='2'):
            evaluate(folder, tmp_path / 'o.json', '--held-out-share', '0.5', *more)
        assert error in capsys.readouterr().err
    assert not (tmp_path / 'o.json').exists()


def test_several_processes_find_the_same(folder, tmp_path):
    results = [
        evaluate(folder, tmp_path / f'{count}.json', '--processes', count)['results']
        for count in ('1', '2')
    ]
    assert results[0] == results[1]


def row(checkpoint: str, budget: int, error: float, lr: float = 0.1) -> dict:
    return {
        'checkpoint': checkpoint,
        'budget': budget,
        'epsilon': 1.0,
        'lr': lr,
        'error': {'mean': error},
    }


def test_rank_correlation_is_of_what_both_know():
    results = [row('a', 0, 0.9), row('a', 5, 0.5), row('b', 5, 0.2), row('b', 9, 0.3)]
    # Without adaptation the learning rate does not count: the same policy, not another one.
    results += [row('a', 0, 0.9, lr=0.2), row('c', 1, 0.1)]
    success = {
        ('a', 0, None, None): 0.1,
        ('a', 5, 1.0, 0.1): 0.4,
        ('b', 5, 1.0, 0.1): 0.8,
        ('b', 9, 1.0, 0.1): 0.9,
    }
    found = correlation(results, success)
    assert found['arms'] == 4
    assert found['spearman']['mean'] == pytest.approx(0.8)
    assert found['within'] == pytest.approx({'a': 1.0, 'b': -1.0})
    assert found['within_mean'] == pytest.approx({'mean': 0, 'low': -1, 'high': 1})
    with pytest.raises(ValueError, match='only 1 of the policies'):
        correlation(results[:1], success)


def test_ranks_are_those_of_scipy_with_ties():
    pairs = np.array([[1, 2], [1, 3], [2, 3], [5, 1], [4, 9.0]])
    assert spearman(pairs) == pytest.approx(scipy.stats.spearmanr(*pairs.T).statistic)
    assert np.isnan(spearman(np.array([[1, 2], [1, 3.0]])))
