"""The replayed inner loop equals the plain one: its bookkeeping anywhere, its graph on a GPU."""

from metagcttt_core.adaptation import graphed
from metagcttt_core.adaptation.graphed import GraphedInnerLoop
from metagcttt_core.adaptation.inner_loop import run_inner_loop
import numpy as np
import pytest
from tests.core.adaptation.test_inner_loop import batches_for
from tests.core.builders import assert_bit_equal, tiny_agent, weights_of
import torch

BACKBONES = pytest.mark.parametrize(
    ('name', 'settings'),
    [
        ('gcbc', {}),
        ('gciql', {'actor_loss': 'bc'}),
        ('gciql', {'actor_loss': 'awr'}),
        ('gciql', {'actor_loss': 'ddpgbc'}),
        ('saw', {}),
        ('crl', {}),
        ('crl', {'actor_loss': 'awr'}),
    ],
)
OPTIMIZERS = pytest.mark.parametrize(('optimizer', 'lr'), [('adam', 0.1), ('sgd', 0.1)])


@pytest.fixture
def without_a_gpu(monkeypatch):
    """Steps that warm up and write to fixed memory as a graph's do, without a graph."""

    def captured(step):
        for _ in range(3):
            result = step()
        return lambda: result.copy_(step()), result

    monkeypatch.setattr(graphed, 'captured', captured)


@BACKBONES
@OPTIMIZERS
@pytest.mark.parametrize('actor_only', [False, True])
def test_one_object_adapts_task_after_task_as_the_plain_loop(
    name, settings, optimizer, lr, actor_only, without_a_gpu
):
    shared = {'lr': lr, 'optimizer': optimizer, 'actor_only': actor_only}
    loop = GraphedInnerLoop(tiny_agent(name, **settings), **shared)
    for seed in (3, 4):
        base = tiny_agent(name, seed, **settings)
        weights = weights_of(base)
        batches = batches_for(base, 6, seed=seed)
        test_batch = batches_for(base, 1, 5 + seed, seed=9)[0] if seed == 4 else None
        result = loop(base, iter(batches), test_batch=test_batch)
        expected = run_inner_loop(base, batches, test_batch=test_batch, **shared)
        assert_bit_equal(base, weights)
        assert_bit_equal(result.agent, weights_of(expected.agent))
        assert result.train_losses == expected.train_losses
        assert result.test_losses == expected.test_losses
        assert result.best_step == expected.best_step


def test_experts_stay_as_they_are_while_others_are_made(without_a_gpu):
    base = tiny_agent()
    loop = GraphedInnerLoop(base, lr=0.1)
    first = loop(base, batches_for(base, 3, seed=1)).agent
    weights = weights_of(first)
    second = loop(base, batches_for(base, 3, seed=2)).agent
    assert_bit_equal(first, weights)
    assert not torch.equal(second.actor.mean.bias, first.actor.mean.bias)
    assert all(weight.grad is None for weight in first.parameters())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason='needs a CUDA device')
@BACKBONES
@OPTIMIZERS
@pytest.mark.parametrize('actor_only', [False, True])
def test_replayed_graph_equals_the_plain_loop(name, settings, optimizer, lr, actor_only):
    shared = {'lr': lr / 100, 'optimizer': optimizer, 'actor_only': actor_only}
    loop = GraphedInnerLoop(tiny_agent(name, **settings).cuda(), **shared)
    for seed in (3, 4):
        base = tiny_agent(name, seed, **settings).cuda()
        batches = batches_for(base, 6, seed=seed)
        (test_batch,) = batches_for(base, 1, seed=9)
        result = loop(base, batches, test_batch=test_batch)
        expected = run_inner_loop(base, batches, test_batch=test_batch, **shared)
        np.testing.assert_allclose(result.train_losses, expected.train_losses, rtol=1e-4)
        np.testing.assert_allclose(result.test_losses, expected.test_losses, rtol=1e-4)
        for key, weight in expected.agent.state_dict().items():
            torch.testing.assert_close(
                result.agent.state_dict()[key], weight, rtol=1e-3, atol=1e-4
            )
