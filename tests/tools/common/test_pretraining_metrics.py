"""What a pre-training run shows while it runs, and that looking changes nothing."""

import json
import re

from metagcttt_core import Agent, load_checkpoint, TrajectoryDataset
from metagcttt_core.data import GoalRelabeller
from metagcttt_core.training.run import TrainingRun
from metagcttt_tools import pretrain
from metagcttt_tools.common import pretraining_metrics
from metagcttt_tools.common.pretraining_metrics import Throughput, Validation, validation_data
import numpy as np
import pytest
from tests.core.builders import random_dataset, tiny_agent, weights_of
import torch

LOOKING = ['--snapshot-every', '2', '--evaluate-every', '4', '--evaluation-episodes', '1']


@pytest.fixture
def data(tmp_path):
    """A dataset and, beside it, its validation file."""
    random_dataset([20, 20]).save(tmp_path / 'walks.npz')
    random_dataset([20], seed=5).save(tmp_path / 'walks-val.npz')
    return tmp_path / 'walks.npz'


@pytest.fixture
def rates(monkeypatch):
    """Replaces the simulator; tells which weights were evaluated."""
    evaluated = []

    def evaluate(agent: Agent, environment: str, episodes: int, seed: int):
        evaluated.append(weights_of(agent))
        return {'evaluation/success': 0.25}

    monkeypatch.setattr(pretraining_metrics, 'success_rates', evaluate)
    return evaluated


def train(data, out, *arguments):
    small = ['--agent', 'gciql', '--hidden', '8', '--training.batch-size', '16']
    run = ['--dataset', str(data), '--out', str(out), '--log-every', '2']
    pretrain.main([*small, *run, '--training.steps', '6', *arguments])
    lines = (out / 'metrics.jsonl').read_text().splitlines()
    return {record['step']: record for record in map(json.loads, lines)}


def test_log_holds_training_and_validation_losses_speed_and_success(data, tmp_path, rates):
    log = train(data, tmp_path / 'run', *LOOKING)
    assert list(log) == [2, 4, 6]
    for record in log.values():
        for name in ('loss', 'value', 'critic', 'actor', 'bc'):
            assert np.isfinite(record[f'train/{name}'])
            assert np.isfinite(record[f'val/{name}'])
            assert record[f'train/{name}'] != record[f'val/{name}']
        assert record['speed/updates_per_s'] > 0
    assert [step for step in log if 'evaluation/success' in log[step]] == [4]
    assert len(rates) == 1


def test_snapshots_are_the_policy_after_those_steps(data, tmp_path, rates):
    out = tmp_path / 'run'
    train(data, out, *LOOKING)
    assert sorted(folder.name for folder in (out / 'snapshots').iterdir()) == [
        '000002',
        '000004',
        '000006',
    ]
    for name, tensor in load_checkpoint(out / 'snapshots' / '000004').state_dict().items():
        assert torch.equal(tensor, rates[0][name])
    last = load_checkpoint(out / 'snapshots' / '000006').state_dict()
    for name, tensor in load_checkpoint(out / 'checkpoint').state_dict().items():
        assert torch.equal(tensor, last[name])


@pytest.mark.parametrize('precision', ['float32', 'bfloat16'])
def test_looking_and_interruptions_leave_the_same_bits(
    precision, data, tmp_path, rates, monkeypatch
):
    arguments = ['--precision', precision, '--checkpoint-every', '1']
    (tmp_path / 'walks-val.npz').rename(tmp_path / 'aside.npz')
    train(data, tmp_path / 'plain', *arguments)
    (tmp_path / 'aside.npz').rename(tmp_path / 'walks-val.npz')
    step_done = TrainingRun.step_done

    def killed(run, agent, optimizer, step, last):
        step_done(run, agent, optimizer, step, last)
        if step == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(TrainingRun, 'step_done', killed)
    with pytest.raises(KeyboardInterrupt):
        train(data, tmp_path / 'broken', *arguments, *LOOKING)
    monkeypatch.setattr(TrainingRun, 'step_done', step_done)
    log = train(data, tmp_path / 'broken', *arguments, *LOOKING, '--resume')
    assert list(log) == [2, 4, 6]
    plain = load_checkpoint(tmp_path / 'plain' / 'checkpoint').state_dict()
    broken = load_checkpoint(tmp_path / 'broken' / 'checkpoint').state_dict()
    assert all(torch.equal(plain[name], tensor) for name, tensor in broken.items())


def test_other_precision_is_not_resumed(data, tmp_path, capsys):
    train(data, tmp_path / 'run')
    with pytest.raises(SystemExit, match='2'):
        train(data, tmp_path / 'run', '--resume', '--precision', 'bfloat16')
    assert "precision was 'float32' and is now 'bfloat16'" in capsys.readouterr().err


def test_settings_of_the_agent_reach_the_policy(data, tmp_path):
    goals = ['--gciql.goals.actor.p-trajgoal', '0.5', '--gciql.goals.actor.p-randomgoal', '0.5']
    train(data, tmp_path / 'run', '--gciql.alpha', '0.003', '--gciql.actor-loss', 'awr', *goals)
    settings = load_checkpoint(tmp_path / 'run' / 'checkpoint').settings
    assert (settings.alpha, settings.actor_loss, settings.hidden) == (0.003, 'awr', (8,))
    assert settings.goals.actor.p_randomgoal == 0.5


@pytest.mark.parametrize(
    ('flags', 'message'),
    [
        (('--gciql.hidden', '32'), 'Unrecognized options: --gciql.hidden'),
        (('--gcbc.discount', '0.9'), 'agent is gciql: the settings of gcbc have no effect'),
        (('--agent', 'gcbc', '--gcbc.goals.no-gc-negative'), 'goals.gc_negative have no effect'),
    ],
)
def test_settings_without_effect_are_refused(flags, message, data, tmp_path, capsys):
    with pytest.raises(SystemExit, match='2'):
        train(data, tmp_path / 'run', *flags)
    assert message in re.sub(r'[\s│]+', ' ', capsys.readouterr().err)


def test_validation_draws_from_its_own_data_and_repeats(data):
    held_out = TrajectoryDataset.load(data.with_name('walks-val.npz'))
    agent = tiny_agent()
    validation = Validation(held_out, 16, 'float32')
    losses = validation.losses(agent, seed=3, step=7)
    assert losses == validation.losses(agent, seed=3, step=7)
    assert losses != validation.losses(agent, seed=3, step=8)
    relabeller = GoalRelabeller(held_out, agent.settings.goals, agent.settings.discount)
    batch = agent.tensors(relabeller.sample(16, np.random.default_rng((3, 7, 1))))
    assert losses['val/loss'] == agent.losses(batch)[0].item()


def test_no_validation_file_is_no_validation(data):
    data.with_name('walks-val.npz').unlink()
    dataset = TrajectoryDataset.load(data)
    assert validation_data(data, dataset) is None
    assert Validation(None, 16, 'float32').losses(tiny_agent(), 0, 1) == {}


def test_validation_file_of_another_width_is_refused_by_name(data, tmp_path, capsys):
    random_dataset([20], obs_dim=3).save(data.with_name('walks-val.npz'))
    with pytest.raises(SystemExit, match='2'):
        train(data, tmp_path / 'run')
    assert 'walks-val.npz: obs_dim is 3, that of' in capsys.readouterr().err


def test_throughput_is_updates_by_seconds_since_the_last_restart(monkeypatch):
    now = iter([10.0, 14.0, 20.0, 21.0])
    monkeypatch.setattr(pretraining_metrics.time, 'perf_counter', lambda: next(now))
    throughput = Throughput()
    for _ in range(8):
        throughput.count()
    assert throughput.rate() == 2.0
    throughput.restart()
    throughput.count()
    assert throughput.rate() == 1.0


@pytest.mark.mujoco
def test_success_is_that_of_the_simulator_s_tasks():
    agent = tiny_agent()
    with torch.no_grad():
        for weight in agent.parameters():
            weight.zero_()
    found = pretraining_metrics.success_rates(agent, 'pointmaze-medium-v0', episodes=1, seed=0)
    assert found == {f'evaluation/task{task}': 0.0 for task in range(1, 6)} | {
        'evaluation/success': 0.0
    }
