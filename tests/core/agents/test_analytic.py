"""Gradients written out equal autograd's, and the passes of a network equal its module's."""

from metagcttt_core.agents import GCBC
from metagcttt_core.agents.networks import MLP
from metagcttt_core.agents.passes import FusedPasses, TensorPasses
from metagcttt_core.kernels import load_kernels
import pytest
from tests.core.adaptation.test_inner_loop import batches_for
from tests.core.builders import tiny_agent
import torch

LEARNERS = pytest.mark.parametrize(
    ('name', 'settings'),
    [
        ('gcbc', {}),
        ('gciql', {'actor_loss': 'bc'}),
        ('gciql', {'actor_loss': 'awr'}),
        ('gciql', {'actor_loss': 'ddpgbc'}),
        ('saw', {}),
    ],
)
WIDE = {'hidden': (160, 144)}  # whose products with 160 rows go to oneDNN
WAYS = pytest.mark.parametrize('way', ['tensor operations', 'kernels'])


def kernels_of(way):
    return load_kernels() if way == 'kernels' else None


def relative_error(found, expected) -> float:
    return ((found - expected).norm() / expected.norm()).item()


@WAYS
@LEARNERS
@pytest.mark.parametrize('actor_only', [False, True])
@pytest.mark.parametrize(('shape', 'rows'), [({}, 16), (WIDE, 160)], ids=['tiny', 'wide'])
def test_loss_parts_and_gradients_equal_autograd(name, settings, actor_only, shape, rows, way):
    agent = tiny_agent(name, **settings, **shape)
    loss_of = agent.analytic_loss(actor_only=actor_only, kernels=kernels_of(way))
    for batch in batches_for(agent, 2, size=rows):  # the second in the memory of the first
        loss, parts = agent.losses(batch, actor_only=actor_only)
        gradients = torch.autograd.grad(
            loss, list(agent.trained_parameters(actor_only=actor_only))
        )
        found, found_parts = loss_of(batch)
        torch.testing.assert_close(found, loss.detach(), rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(found_parts, parts, rtol=1e-4, atol=1e-5)
        for written, expected in zip(loss_of.gradients, gradients, strict=True):
            assert relative_error(written, expected) < 2e-5


@WAYS
@LEARNERS
@pytest.mark.parametrize('actor_only', [False, True])
def test_products_in_bfloat16_move_the_gradients_by_their_rounding(
    name, settings, actor_only, way
):
    agent = tiny_agent(name, **settings, hidden=(64, 64))
    (batch,) = batches_for(agent, 1, size=256)
    shared = {'actor_only': actor_only, 'kernels': kernels_of(way)}
    exact = agent.analytic_loss(**shared)
    rounded = agent.analytic_loss(**shared, dtype=torch.bfloat16)
    exact(batch)
    rounded(batch)
    errors = [
        relative_error(a, b) for a, b in zip(rounded.gradients, exact.gradients, strict=True)
    ]
    assert 1e-4 < max(errors) < 0.1
    assert all(gradient.dtype == torch.float32 for gradient in rounded.gradients)


@WAYS
@LEARNERS
def test_loss_without_backward_leaves_the_gradients(name, settings, way):
    agent = tiny_agent(name, **settings)
    first, second = batches_for(agent, 2)
    loss_of = agent.analytic_loss(kernels=kernels_of(way))
    loss_of(first)
    kept = [gradient.clone() for gradient in loss_of.gradients]
    loss, _ = loss_of(second, backward=False)
    torch.testing.assert_close(loss, agent.losses(second)[0].detach(), rtol=1e-5, atol=1e-6)
    assert all(torch.equal(a, b) for a, b in zip(kept, loss_of.gradients, strict=True))


def test_equal_critics_share_the_gradient_as_autograd_divides_it():
    agent = tiny_agent('gciql', actor_loss='ddpgbc')
    agent.critic2.load_state_dict(agent.critic1.state_dict())
    (batch,) = batches_for(agent, 1)
    loss_of = agent.analytic_loss(actor_only=True)
    loss_of(batch)
    gradients = torch.autograd.grad(
        agent.losses(batch, actor_only=True)[0], list(agent.actor.parameters())
    )
    for written, expected in zip(loss_of.gradients, gradients, strict=True):
        assert relative_error(written, expected) < 2e-5


@pytest.mark.parametrize('name', ['gcbc', 'gciql', 'saw'])
def test_learned_deviation_and_subclasses_have_none(name):
    class Other(GCBC):
        pass

    assert tiny_agent(name, const_std=False).analytic_loss() is None
    subclassed = tiny_agent()
    subclassed.__class__ = Other
    assert subclassed.analytic_loss() is None


@WAYS
@pytest.mark.parametrize('layer_norm', [False, True])
@pytest.mark.parametrize('products', ['as found', 'without oneDNN', 'slow BLAS', 'by layer'])
def test_passes_equal_the_module(layer_norm, products, way, monkeypatch):
    passes_module = 'metagcttt_core.agents.passes'
    if products == 'without oneDNN':
        monkeypatch.setattr(f'{passes_module}._OPS', None)
    elif products == 'slow BLAS':
        monkeypatch.setattr(f'{passes_module}._blas_keeps_up', lambda: False)
    elif products == 'by layer':
        monkeypatch.setattr(f'{passes_module}._ONE_CALL', 0)
    generator = torch.Generator().manual_seed(0)
    mlp = MLP(5, (130, 140), 3, layer_norm=layer_norm, generator=generator)
    passes = FusedPasses(mlp, load_kernels()) if way == 'kernels' else TensorPasses(mlp)
    for rows in (7, 200):
        inputs = torch.randn(rows, 5, generator=generator, requires_grad=True)
        upstream = torch.randn(rows, 3, generator=generator)
        outputs = mlp(inputs)
        torch.testing.assert_close(passes.forward(inputs.detach()), outputs.detach())
        others = torch.randn(3 * rows, 5, generator=generator)  # keep nothing, leave what is kept
        torch.testing.assert_close(passes.evaluate(others), mlp(others).detach())
        expected = torch.autograd.grad(outputs, [inputs, *mlp.parameters()], upstream)
        found = passes.backward(upstream.clone(), inputs=True)
        for own, reference in zip([found, *passes.gradients], expected, strict=True):
            assert relative_error(own, reference) < 2e-5
