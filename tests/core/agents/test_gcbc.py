"""GCBC against the reference implementation and by hand."""

import math

from metagcttt_core import make_agent
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.step import gradient_step
import numpy as np
import pytest
from tests.core.builders import DATA, tiny_agent
import torch


@pytest.fixture(scope='module', params=['pm', 'ant'])
def golden(request) -> dict[str, np.ndarray]:
    with np.load(DATA / f'nets_gcbc_{request.param}.npz') as arrays:
        return dict(arrays)


def part(golden, prefix: str) -> dict[str, np.ndarray]:
    """The arrays under a prefix, by the rest of their names."""
    return {
        name.removeprefix(f'{prefix}.'): array
        for name, array in golden.items()
        if name.startswith(f'{prefix}.')
    }


@pytest.fixture
def agent(golden):
    batch = part(golden, 'batch')
    agent = make_agent(
        'gcbc',
        obs_dim=batch['observations'].shape[1],
        act_dim=batch['actions'].shape[1],
        hidden=golden['meta.hidden_dims'],
    )
    agent.import_reference_parameters(part(golden, 'init'))
    return agent


def test_outputs_equal_the_reference(agent, golden):
    batch = agent.tensors(part(golden, 'batch'))
    with torch.no_grad():
        log_prob, mean = agent.log_prob(
            batch['observations'], batch['actor_goals'], batch['actions']
        )
    np.testing.assert_allclose(mean, golden['out.actor_mean'], rtol=1e-5, atol=5e-5)
    np.testing.assert_allclose(log_prob, golden['out.log_prob'], rtol=1e-5, atol=5e-5)
    actions = agent.act(golden['batch.observations'], golden['batch.actor_goals'])
    np.testing.assert_allclose(actions, golden['out.eval_action'], rtol=1e-5, atol=5e-5)


def test_loss_equals_the_reference(agent, golden):
    loss, parts = agent.losses(agent.tensors(part(golden, 'batch')))
    assert loss.item() == pytest.approx(golden['loss.bc'], rel=1e-5)
    assert parts['bc'].item() == pytest.approx(golden['loss.bc'], rel=1e-5)
    assert parts['mse'].item() == pytest.approx(golden['loss.mse'], rel=1e-5)
    assert not any(value.requires_grad for value in parts.values())


def test_gradient_equals_the_reference(agent, golden):
    agent.losses(agent.tensors(part(golden, 'batch')))[0].backward()
    for name, expected in part(golden, 'grad').items():
        own = agent.get_parameter(name.replace('kernel', 'weight')).grad
        own = own.T if name.endswith('kernel') else own
        np.testing.assert_allclose(own, expected, rtol=0, atol=5e-5, err_msg=name)


def test_adam_steps_equal_the_reference(agent, golden):
    batch = agent.tensors(part(golden, 'batch'))
    parameters = list(agent.trained_parameters())
    optimizer = make_optimizer('adam', parameters, float(golden['meta.lr']))
    losses = []
    for step in range(1, 6):
        loss, _ = gradient_step(agent, optimizer, parameters, batch)
        losses.append(loss.item())
        if f'adam{step}.actor.mean.bias' in golden:
            exported = agent.export_reference_parameters()
            tolerance = {1: 1e-6, 5: 1e-5}[step]
            for name, expected in part(golden, f'adam{step}').items():
                np.testing.assert_allclose(
                    exported[name], expected, rtol=0, atol=tolerance, err_msg=f'{step} {name}'
                )
    losses.append(agent.losses(batch)[0].item())
    np.testing.assert_allclose(losses, golden['loss_traj.bc'], rtol=1e-5)


def test_learned_deviation_by_hand():
    """Log N(a; m, s) with log s clipped to [-5, 2], summed over the action."""
    agent = tiny_agent(const_std=False)
    with torch.no_grad():
        agent.actor.log_stds.copy_(torch.tensor([0.3, 7.0]))
    rng = np.random.default_rng(0)
    batch = agent.tensors(
        {
            name: rng.normal(size=(5, 2)).astype(np.float32)
            for name in ('observations', 'actor_goals', 'actions')
        }
    )
    log_prob, mean = agent.log_prob(batch['observations'], batch['actor_goals'], batch['actions'])
    expected = []
    for action, center in zip(batch['actions'].tolist(), mean.tolist(), strict=True):
        expected.append(
            sum(
                -0.5 * ((a - m) / math.exp(log_std)) ** 2 - log_std - 0.5 * math.log(2 * math.pi)
                for a, m, log_std in zip(action, center, (0.3, 2.0), strict=True)
            )
        )
    np.testing.assert_allclose(log_prob.detach(), expected, rtol=1e-5)
    loss, _ = agent.losses(batch)
    assert loss.item() == pytest.approx(-np.mean(expected), rel=1e-5)
    loss.backward()
    # Inside the range the deviation learns: d/d log s of -log_prob is 1 - ((a - m) / s)^2.
    error = (batch['actions'] - mean.detach())[:, 0] / math.exp(0.3)
    assert agent.actor.log_stds.grad[0].item() == pytest.approx(
        (1 - error.square()).mean().item(), rel=1e-4
    )
    assert agent.actor.log_stds.grad[1].item() == 0


def test_agent_has_no_critic():
    assert tiny_agent().value_fn is None
    assert tiny_agent().settings.goals.value is None
