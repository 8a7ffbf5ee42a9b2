"""Loss curves: the very losses of an adaptation, by part, and what a run logged."""

import dataclasses
import json

from metagcttt_core import adapt, FilterConfig, save_checkpoint, TrajectoryFilter, TTTConfig
from metagcttt_tools import loss_curves
from metagcttt_tools.loss_curves import (
    adaptation_losses,
    loss_picture,
    pretraining_curves,
    roughness,
)
import numpy as np
import pytest
from tests.core.builders import assert_bit_equal, random_dataset, tiny_agent, weights_of
from tests.tools.tables import squeezed


@pytest.fixture
def query():
    dataset = random_dataset([30, 30])
    state, goal = dataset.observations[3], dataset.observations[20]
    support = TrajectoryFilter(dataset, FilterConfig(variant='relevance_only')).query(state, goal)
    return dataset, support, goal


@pytest.mark.parametrize('name', ['crl', 'gcbc', 'gciql', 'saw'])
@pytest.mark.parametrize('actor_only', [False, True])
def test_losses_are_those_of_the_adaptation(name, actor_only, query):
    agent = tiny_agent(name)
    weights = weights_of(agent)
    config = TTTConfig(steps=7, lr=0.01, batch_size=16, actor_only=actor_only)
    losses = adaptation_losses(agent, *query, config, seed=4)
    assert losses['total'] == adapt(agent, *query, config, seed=4).train_losses
    assert_bit_equal(agent, weights)
    others = {'crl': ('critic',), 'gciql': ('critic', 'value'), 'saw': ('subpolicy', 'value')}
    if name in others:
        parts = ('actor', *(() if actor_only else others[name]))
        np.testing.assert_allclose(losses['total'], sum(np.array(losses[p]) for p in parts), 1e-5)


def test_support_too_small_to_adapt_on_is_refused(query):
    dataset, support, goal = query
    config = TTTConfig(steps=2, early_stopping=True)
    nothing = dataclasses.replace(support, indices=support.indices[:0])
    for settings in (config, config.model_copy(update={'early_stopping': False})):
        with pytest.raises(ValueError, match='the filtered dataset is'):
            adaptation_losses(tiny_agent(), dataset, nothing, goal, settings)


def test_roughness_is_the_mean_change_over_the_range():
    assert roughness([0, 1, 2, 3, 4]) == pytest.approx(0.25)
    assert roughness([4, 3, 2, 1, 0]) == pytest.approx(0.25)
    assert roughness([0, 4, 0, 4, 0]) == pytest.approx(1.0)
    assert roughness([0, 40, 0, 40, 0]) == pytest.approx(1.0)
    assert roughness([2, 2, 2]) == 0


def write_log(run, records):
    run.mkdir()
    lines = ''.join(json.dumps(record) + '\n' for record in records)
    (run / 'metrics.jsonl').write_text(lines)
    return run


def test_curves_of_a_run_come_from_its_log(tmp_path):
    records = [
        {'step': 10, 'train/loss': 3.0, 'train/actor': 1.0, 'val/loss': 4.0, 'val/actor': 2.0},
        {'step': 15, 'evaluation/success': 0.5},
        {'step': 20, 'train/loss': 2.0, 'train/actor': 0.5, 'val/loss': 3.5, 'val/actor': 1.5},
    ]
    steps, curves = pretraining_curves(write_log(tmp_path / 'run', records))
    assert steps == [10, 20]
    assert curves == {
        'training': {'total': [3.0, 2.0], 'actor': [1.0, 0.5]},
        'validation': {'total': [4.0, 3.5], 'actor': [2.0, 1.5]},
    }


def test_log_without_losses_is_refused_by_name(tmp_path, capsys):
    run = write_log(tmp_path / 'run', [{'step': 5, 'evaluation/success': 1.0}])
    for folder, message in (
        (run, 'holds no training losses'),
        (tmp_path / 'none', 'No such file'),
    ):
        with pytest.raises(SystemExit, match='2'):
            loss_curves.main(['--run', str(folder), '--out', str(tmp_path / 'out.json')])
        printed = capsys.readouterr().err
        assert message in printed
        assert 'metrics.jsonl' in printed


def test_picture_has_a_panel_for_each_part_and_a_line_for_each_rate():
    curves = {
        'lr 1': {'total': [2, 1], 'bc': [1, 1], 'critic': [5, 4], 'actor': [3, 2]},
        'lr 2': {'total': [2, 0], 'bc': [1, 1], 'critic': [5, 1], 'actor': [3, 0]},
    }
    panels = loss_picture([0, 1], curves, 'steps').axes
    assert [axes.get_title() for axes in panels] == ['total', 'actor', 'critic']
    for axes in panels:
        assert {line.get_label() for line in axes.get_lines()} == {'lr 1', 'lr 2'}
    assert panels[2].get_lines()[1].get_ydata().tolist() == [5, 1]


@pytest.mark.mujoco
def test_command_adapts_to_a_task_with_each_rate(tmp_path, capsys):
    rng = np.random.default_rng(0)
    dataset = random_dataset([200])
    dataset.observations[:] = rng.uniform(0, 20, size=dataset.observations.shape)
    dataset.save(tmp_path / 'data.npz')
    agent = tiny_agent('gciql')
    agent.metadata = {'environment': 'pointmaze-medium-v0'}
    save_checkpoint(agent, tmp_path / 'policy')
    out = tmp_path / 'losses.json'
    files = ['--checkpoint', str(tmp_path / 'policy'), '--dataset', str(tmp_path / 'data.npz')]
    steps = ['--lrs', '1e-3', '1e-2', '--ttt.steps', '5', '--ttt.batch-size', '16']
    others = ['--actor-loss', 'bc', '--filter.epsilon', '4', '--out', str(out)]
    loss_curves.main([*files, *steps, *others])
    results = json.loads(out.read_text())['results']
    assert results['steps'] == [0, 1, 2, 3, 4]
    assert list(results['losses']) == ['lr 0.001', 'lr 0.01']
    for losses in results['losses'].values():
        assert losses['actor'] == losses['bc']
        assert all(len(values) == 5 for values in losses.values())
    assert results['losses']['lr 0.001']['total'][0] == results['losses']['lr 0.01']['total'][0]
    assert results['losses']['lr 0.001']['total'][4] != results['losses']['lr 0.01']['total'][4]
    assert out.with_suffix('.png').read_bytes().startswith(b'\x89PNG')
    assert '| line | total |' in squeezed(capsys.readouterr().out)
