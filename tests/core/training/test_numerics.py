"""Other ways to compute a loss: bfloat16 under autocast, and compiled."""

from functools import partial
from types import SimpleNamespace

from metagcttt_core import make_agent
from metagcttt_core.training import numerics
from metagcttt_core.training.numerics import loss_function, resolve_precision
from metagcttt_core.training.pretrain import pretrain, PretrainConfig
import numpy as np
import pytest
from tests.core.builders import assert_bit_equal, random_dataset, tiny_agent, weights_of
import torch

CUDA = torch.device('cuda')
LEARNERS = pytest.mark.parametrize(
    ('name', 'settings'),
    [
        ('gcbc', {}),
        *(('gciql', {'actor_loss': loss, 'alpha': 0.1}) for loss in ('bc', 'awr', 'ddpgbc')),
        ('saw', {}),
        ('crl', {}),
        ('crl', {'actor_loss': 'awr'}),
    ],
)


def agent_and_batch(name, settings, hidden=(32, 32)):
    agent = tiny_agent(name, hidden=hidden, **settings)
    batch = agent.relabeller(random_dataset([40])).sample(128, np.random.default_rng(0))
    return agent, agent.tensors(batch)


def gradients(agent, losses, batch):
    loss, _ = losses(batch)
    names = [name for name, weight in agent.named_parameters() if weight.requires_grad]
    return dict(
        zip(names, torch.autograd.grad(loss, list(agent.trained_parameters())), strict=True)
    )


@LEARNERS
def test_bfloat16_is_near_float32_in_every_loss_and_gradient(name, settings):
    agent, batch = agent_and_batch(name, settings)
    halved = loss_function(agent, precision='bfloat16')
    loss, parts = agent.losses(batch)
    near_loss, near_parts = halved(batch)
    assert near_loss.item() != loss.item()
    assert near_loss.item() == pytest.approx(loss.item(), rel=0.02)
    for key, part in parts.items():
        assert near_parts[key].dtype == torch.float32, key
        assert near_parts[key].item() == pytest.approx(part.item(), rel=0.05, abs=0.02), key
    exact, near = (gradients(agent, losses, batch) for losses in (agent.losses, halved))
    for key, gradient in exact.items():
        assert near[key].dtype == torch.float32, key
        assert (near[key] - gradient).norm() < 0.1 * gradient.norm() + 1e-3, key


def test_float32_is_the_agent_s_own_loss():
    agent, batch = agent_and_batch('gciql', {})
    assert loss_function(agent)(batch)[0].item() == agent.losses(batch)[0].item()


@pytest.mark.slow
def test_compiled_loss_and_gradients_equal_the_plain_ones():
    agent, batch = agent_and_batch('gcbc', {}, hidden=(16,))
    assert_same_losses_and_gradients(agent, loss_function(agent, compiled=True), batch)


@LEARNERS
def test_what_the_compiler_captures_computes_the_same(name, settings, monkeypatch):
    captured = partial(torch.compile, backend='aot_eager')  # without half a minute of C++
    monkeypatch.setattr(torch, 'compile', lambda losses, options: captured(losses))
    agent, batch = agent_and_batch(name, settings, hidden=(16,))
    assert_same_losses_and_gradients(agent, loss_function(agent, compiled=True), batch)


def assert_same_losses_and_gradients(agent, compiled, batch):
    assert compiled(batch)[0].item() == pytest.approx(agent.losses(batch)[0].item(), rel=1e-5)
    plain, fused = (gradients(agent, losses, batch) for losses in (agent.losses, compiled))
    for key, gradient in plain.items():
        torch.testing.assert_close(fused[key], gradient, rtol=1e-4, atol=1e-5)
    # The compiled loss follows the weights.
    with torch.no_grad():
        for weight in agent.parameters():
            weight.mul_(0.9)
    assert compiled(batch)[0].item() == pytest.approx(agent.losses(batch)[0].item(), rel=1e-5)


@pytest.mark.parametrize('has_matrix_units', [True, False])
def test_auto_is_bfloat16_where_the_device_has_matrix_units(has_matrix_units, monkeypatch):
    monkeypatch.setattr(torch.cpu, 'get_capabilities', lambda: {'amx_bf16': has_matrix_units})
    monkeypatch.setattr(
        torch.cuda, 'is_bf16_supported', lambda including_emulation: has_matrix_units
    )
    expected = 'bfloat16' if has_matrix_units else 'float32'
    agent, _ = agent_and_batch('gcbc', {}, hidden=(256, 256))
    assert resolve_precision('auto', agent) == expected
    on_gpu = SimpleNamespace(device=CUDA, settings=agent.settings)
    assert resolve_precision('auto', on_gpu) == expected
    for named in ('float32', 'bfloat16'):
        assert resolve_precision(named, agent) == named


def test_auto_is_float32_on_a_processor_for_narrow_layers(monkeypatch):
    monkeypatch.setattr(torch.cpu, 'get_capabilities', lambda: {'amx_bf16': True})
    agent, _ = agent_and_batch('gcbc', {}, hidden=(512, 128))
    assert resolve_precision('auto', agent) == 'float32'


def test_processor_that_reports_nothing_computes_in_float32(monkeypatch):
    monkeypatch.setattr(torch.cpu, 'get_capabilities', dict)
    agent, _ = agent_and_batch('gcbc', {}, hidden=(512,))
    assert resolve_precision('auto', agent) == 'float32'


def test_compiled_code_is_made_for_the_number_of_threads(monkeypatch):
    asked = []
    monkeypatch.setattr(
        numerics.torch, 'compile', lambda call, options: asked.append(options) or call
    )
    monkeypatch.setattr(numerics.torch, 'get_num_threads', lambda: 3)
    loss_function(tiny_agent(), compiled=True)
    assert asked[0]['cpp.threads'] == 3


@pytest.mark.parametrize('name', ['crl', 'gcbc', 'gciql', 'saw'])
def test_pretraining_in_bfloat16_repeats_to_the_bit_and_keeps_float32_weights(name):
    agent = make_agent(name, obs_dim=2, act_dim=2, hidden=(16, 16))
    config = PretrainConfig(steps=3, batch_size=16)
    first, second = (
        pretrain(agent, random_dataset(), config, precision='bfloat16') for _ in range(2)
    )
    assert_bit_equal(second, weights_of(first))
    assert all(weight.dtype == torch.float32 for weight in first.parameters())
    plain = pretrain(agent, random_dataset(), config)
    assert not torch.equal(plain.actor.fc0.weight, first.actor.fc0.weight)


@pytest.mark.parametrize(
    ('capabilities', 'told'),
    [
        ({}, 1),
        ({'avx512_bf16': False}, 1),
        ({'avx512_bf16': True}, 0),
        ({'architecture': 'arm64'}, 0),
    ],
)
def test_processor_without_bfloat16_is_named_once(monkeypatch, caplog, capabilities, told):
    given = {'architecture': 'x86_64', **capabilities}
    monkeypatch.setattr(numerics.torch.cpu, 'get_capabilities', lambda: given)
    numerics._warn_of_slow_bfloat16.cache_clear()
    agent = make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(8,))
    for precision in ('float32', 'auto', 'bfloat16', 'bfloat16'):
        resolve_precision(precision, agent)
    numerics._warn_of_slow_bfloat16.cache_clear()
    assert caplog.text.count('has no instructions for it') == told
