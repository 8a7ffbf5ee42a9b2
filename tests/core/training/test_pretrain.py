"""Pre-training: learns, repeats, and resumes bit-identically from every step."""

from functools import partial

from metagcttt_core import CheckpointError, load_checkpoint, save_checkpoint, TrajectoryDataset
from metagcttt_core.data import GoalRelabeller
from metagcttt_core.training import pretrain as pretrain_module
from metagcttt_core.training.engine import make_engine
from metagcttt_core.training.optimizers import pretrained_state
from metagcttt_core.training.pretrain import pretrain, PretrainConfig
from metagcttt_core.training.run import TrainingInterrupted, TrainingRun
import numpy as np
from pydantic import ValidationError
import pytest
from tests.core.builders import (
    assert_bit_equal,
    assert_changed,
    EVERY_AGENT,
    random_dataset,
    terminals_of,
    tiny_agent,
    weights_of,
)
import torch

CONFIG = PretrainConfig(steps=5, lr=0.01, batch_size=8)


def run_in(folder, *, stop_after: int | None = None, resume: bool = False, **settings):
    """A run that is interrupted after some steps of its own."""
    taken = []
    return TrainingRun(
        'pretrain',
        {'seed': 0, **settings},
        folder,
        resume=resume,
        should_stop=lambda: bool(taken.append(1)) or len(taken) == stop_after,
    )


@EVERY_AGENT
def test_pretraining_leaves_the_given_agent_and_repeats(name):
    agent, dataset = tiny_agent(name), random_dataset()
    weights = weights_of(agent)
    first = pretrain(agent, dataset, CONFIG, seed=1)
    assert_bit_equal(agent, weights)
    assert_changed(first, weights)
    assert_bit_equal(pretrain(agent, dataset, CONFIG, seed=1), weights_of(first))
    assert_changed(pretrain(agent, dataset, CONFIG, seed=2), weights_of(first))


@pytest.mark.parametrize('name', ['gcbc', 'gciql', 'saw'])
def test_kernels_pretrain_as_autograd_does(name, monkeypatch):
    agent, dataset = tiny_agent(name), random_dataset()
    by_kernels = pretrain(agent, dataset, CONFIG)
    monkeypatch.setattr(pretrain_module, 'make_engine', partial(eagerly, make_engine))
    by_autograd = pretrain(agent, dataset, CONFIG)
    for own, expected in zip(by_kernels.parameters(), by_autograd.parameters(), strict=True):
        torch.testing.assert_close(own, expected, rtol=1e-3, atol=1e-4)
    moments = [pretrained_state(trained) for trained in (by_kernels, by_autograd)]
    torch.testing.assert_close(*moments, rtol=1e-3, atol=1e-5)


def eagerly(make_engine, name, *arguments, **named):
    return make_engine('eager', *arguments, **named)


@EVERY_AGENT
def test_agent_comes_with_the_state_of_its_optimizer(name, tmp_path):
    """Also from checkpoints, of the run and of the steps on its way."""
    agent, dataset = tiny_agent(name), random_dataset()
    run = run_in(tmp_path / 'run')

    def keep(step, losses, agent):
        save_checkpoint(agent, tmp_path / f'{step}')

    trained = pretrain(agent, dataset, CONFIG, run=run, on_step=keep)
    assert agent.optimizer_state is None
    state = pretrained_state(trained)
    assert {float(moments['step']) for moments in state.values()} == {5.0}
    assert len(state) == len(list(trained.trained_parameters()))
    for folder, step in (('run', 5), ('5', 5), ('2', 2)):
        loaded = pretrained_state(load_checkpoint(tmp_path / folder))
        assert {float(moments['step']) for moments in loaded.values()} == {step}
        same = [torch.equal(loaded[n]['exp_avg'], state[n]['exp_avg']) for n in state]
        assert all(same) if step == 5 else not any(same)


def test_every_step_is_reported_with_its_losses():
    reports = []
    pretrain(
        tiny_agent(),
        random_dataset(),
        CONFIG,
        on_step=lambda step, losses, agent: reports.append((step, losses)),
    )
    assert [step for step, _ in reports] == [1, 2, 3, 4, 5]
    for _, losses in reports:
        assert losses.keys() == {'loss', 'bc', 'mse'}
        assert losses['loss'] == losses['bc']
        assert not losses['loss'].requires_grad


def test_every_step_draws_another_batch(monkeypatch):
    batches, sample = [], GoalRelabeller.sample

    def spy(relabeller, size, rng):
        batches.append(sample(relabeller, size, rng))
        return batches[-1]

    monkeypatch.setattr(GoalRelabeller, 'sample', spy)
    pretrain(tiny_agent(), random_dataset([50]), CONFIG)
    assert len({batch['observations'].tobytes() for batch in batches}) == 5
    assert len({batch['actor_goals'].tobytes() for batch in batches}) == 5


def test_policy_learns_the_dataset_s_actions():
    """Every action points right; cloning has to find that out."""
    rows = 200
    rng = np.random.default_rng(0)
    dataset = TrajectoryDataset.from_arrays(
        rng.normal(size=(rows, 2)),
        np.tile([0.8, -0.3], (rows, 1)),
        terminals_of([100, 100]),
    )
    agent = tiny_agent(hidden=(16,))
    config = PretrainConfig(steps=300, lr=0.01, batch_size=32)
    trained = pretrain(agent, dataset, config)
    states = rng.normal(size=(50, 2))
    errors = [
        np.abs(policy.act(states, states[::-1].copy()) - [0.8, -0.3]).mean()
        for policy in (agent, trained)
    ]
    assert errors[0] > 0.3
    assert errors[1] < 0.15


@EVERY_AGENT
def test_resuming_after_any_step_gives_the_same_bits(name, tmp_path):
    agent, dataset = tiny_agent(name), random_dataset()
    expected = weights_of(pretrain(agent, dataset, CONFIG))
    for interrupted_at in range(1, CONFIG.steps):
        folder = tmp_path / str(interrupted_at)
        message = f'stopped after step {interrupted_at} of 5'
        with pytest.raises(TrainingInterrupted, match=message):
            pretrain(agent, dataset, CONFIG, run=run_in(folder, stop_after=interrupted_at))
        assert_changed(load_checkpoint(folder), expected)
        steps = []
        resumed = pretrain(
            agent,
            dataset,
            CONFIG,
            run=run_in(folder, resume=True),
            on_step=lambda step, losses, agent, steps=steps: steps.append(step),
        )
        assert steps == list(range(interrupted_at + 1, 6))
        assert_bit_equal(resumed, expected)
        assert_bit_equal(load_checkpoint(folder), expected)


def test_interrupting_a_resumed_run_again_gives_the_same_bits(tmp_path):
    agent, dataset = tiny_agent(), random_dataset()
    expected = weights_of(pretrain(agent, dataset, CONFIG))
    for _ in range(4):
        with pytest.raises(TrainingInterrupted):
            pretrain(agent, dataset, CONFIG, run=run_in(tmp_path, stop_after=1, resume=True))
    assert_bit_equal(pretrain(agent, dataset, CONFIG, run=run_in(tmp_path, resume=True)), expected)


def test_finished_run_is_not_trained_further(tmp_path):
    agent, dataset = tiny_agent(), random_dataset()
    trained = pretrain(agent, dataset, CONFIG, run=run_in(tmp_path))
    again = pretrain(agent, dataset, CONFIG, run=run_in(tmp_path, resume=True))
    assert_bit_equal(again, weights_of(trained))


def test_resuming_with_other_settings_is_refused_by_name(tmp_path):
    agent, dataset = tiny_agent(), random_dataset()
    pretrain(agent, dataset, CONFIG, run=run_in(tmp_path, lr=0.01))
    with pytest.raises(CheckpointError, match=r'cannot resume, lr was 0.01 and is now 0.02'):
        pretrain(agent, dataset, CONFIG, run=run_in(tmp_path, resume=True, lr=0.02))


def test_checkpoint_keeps_the_metadata(tmp_path):
    agent = tiny_agent()
    agent.metadata = {'environment': 'maze', 'history': [{'stage': 'pretrain'}]}
    trained = pretrain(agent, random_dataset(), CONFIG, run=run_in(tmp_path))
    assert trained.metadata == load_checkpoint(tmp_path).metadata == agent.metadata


def test_defaults_are_those_of_the_paper():
    config = PretrainConfig()
    assert (config.steps, config.lr, config.batch_size) == (400_000, 3e-4, 1024)


@pytest.mark.parametrize('settings', [{'steps': 0}, {'lr': 0.0}, {'batch_size': 0}])
def test_wrong_setting_is_refused_by_name(settings):
    (name,) = settings
    with pytest.raises(ValidationError, match=f'{name}\n.*greater than'):
        PretrainConfig(**settings)
