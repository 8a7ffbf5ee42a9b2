"""MAML's gradient against finite differences and against first-order MAML."""

from functools import partial

from metagcttt_core import MetaConfig, post_train, TrajectoryFilter
from metagcttt_core.adaptation.inner_loop import run_inner_loop
from metagcttt_core.meta import experts, updates
from metagcttt_core.meta.second_order import meta_gradient
import numpy as np
import pytest
from tests.core.builders import random_dataset, tiny_agent
import torch

ACTOR_KEYS = ('observations', 'actions', 'actor_goals')


def batches(count, seed=0, dtype=torch.float64):
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        batch = {key: torch.tensor(rng.normal(size=(5, 2)), dtype=dtype) for key in ACTOR_KEYS}
        for key in ('next_observations', 'value_goals', 'subgoals', 'waypoints'):
            batch[key] = torch.tensor(rng.normal(size=(5, 2)), dtype=dtype)
        batch['rewards'] = torch.tensor([-1.0, -1, 0, -1, 0], dtype=dtype)
        batch['masks'] = -batch['rewards']
        made.append(batch)
    return made


def loss_after(agent, train, test, **settings):
    expert = run_inner_loop(agent, train, **settings).agent
    with torch.no_grad():
        return expert.losses(test)[0].item()


@pytest.mark.parametrize('optimizer', ['sgd', 'adam'])
@pytest.mark.parametrize('num_steps', [0, 1, 3])
@pytest.mark.parametrize('const_std', [True, False])
def test_gradient_equals_finite_differences(const_std, optimizer, num_steps):
    agent = tiny_agent(const_std=const_std).double()
    *train, test = batches(num_steps + 1)
    settings = {'lr': 0.05, 'optimizer': optimizer}
    gradients = meta_gradient(agent, train, test, **settings)
    after = partial(loss_after, train=train, test=test, **settings)
    rng = np.random.default_rng(1)
    for parameter, gradient in zip(agent.trained_parameters(), gradients, strict=True):
        assert torch.isfinite(gradient).all()
        flat = parameter.data.view(-1)
        for index in rng.choice(len(flat), size=min(4, len(flat)), replace=False):
            original, step = flat[index].item(), 1e-6
            flat[index] = original + step
            above = after(agent)
            flat[index] = original - step
            below = after(agent)
            flat[index] = original
            slope = (above - below) / (2 * step)
            assert gradient.view(-1)[index].item() == pytest.approx(slope, rel=2e-4, abs=1e-6)


@pytest.mark.parametrize('name', ['crl', 'gcbc', 'gciql', 'saw'])
@pytest.mark.parametrize('optimizer', ['sgd', 'adam'])
def test_without_the_second_order_term_it_is_fomaml(name, optimizer):
    agent = tiny_agent(name).double()
    *train, test = batches(4)
    expert = run_inner_loop(agent, train, lr=0.01, optimizer=optimizer).agent
    loss, _ = expert.losses(test)
    fomaml = torch.autograd.grad(loss, list(expert.trained_parameters()))
    settings = {'lr': 0.01, 'optimizer': optimizer}
    first_order = meta_gradient(agent, train, test, first_order=True, **settings)
    second_order = meta_gradient(agent, train, test, **settings)
    for ours, theirs in zip(first_order, fomaml, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-12)
    assert any(
        not torch.allclose(ours, theirs, rtol=1e-3)
        for ours, theirs in zip(second_order, fomaml, strict=True)
    )


def test_base_is_not_changed():
    agent = tiny_agent('gciql').double()
    before = agent.clone().state_dict()
    meta_gradient(agent, *[batches(3)], batches(1, seed=9)[0], lr=0.1)
    for name, tensor in agent.state_dict().items():
        assert torch.equal(tensor, before[name])
        assert tensor.grad is None


def test_post_training_repeats_the_very_batches_of_the_inner_loop(monkeypatch):
    dataset = random_dataset((30, 20, 25), seed=3)
    seen = {'inner': [], 'meta': []}

    def recording(which, iterable):
        for batch in iterable:
            seen[which].append(batch['actions'])
            yield batch

    def inner(base, drawn, **settings):
        return run_inner_loop(base, recording('inner', drawn), **settings)

    def outer(base, drawn, *arguments, **settings):
        return meta_gradient(base, recording('meta', drawn), *arguments, **settings)

    monkeypatch.setattr(experts, 'run_inner_loop', inner)
    monkeypatch.setattr(experts, '_LARGEST_STACKED_ON_CPU', 0)
    monkeypatch.setattr(updates, 'meta_gradient', outer)
    settings = {'outer_steps': 2, 'inner_steps': 3, 'batch_size': 4, 'early_stopping': False}
    config = MetaConfig(algorithm='maml', meta_batch_size=2, **settings)
    assert len(TrajectoryFilter(dataset).query(dataset.observations[0], dataset.observations[3]))
    agent = tiny_agent()
    trained = post_train(agent, dataset, config)
    assert len(seen['inner']) == len(seen['meta']) == 2 * 2 * 3
    # Per outer step, both tasks adapt before the update repeats them.
    assert all(torch.equal(a, b) for a, b in zip(seen['inner'], seen['meta'], strict=True))
    assert not torch.equal(trained.actor.mean.weight, agent.actor.mean.weight)
