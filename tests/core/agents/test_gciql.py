"""GCIQL against the reference implementation."""

from metagcttt_core import make_agent
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.step import gradient_step
import numpy as np
import pytest
from tests.core.builders import assert_bit_equal, DATA, tiny_agent, weights_of
import torch

ACTOR_LOSSES = pytest.mark.parametrize('actor_loss', ['ddpgbc', 'awr'])


@pytest.fixture(scope='module', params=['pm', 'ant'])
def golden(request) -> dict[str, np.ndarray]:
    with np.load(DATA / f'nets_gciql_{request.param}.npz') as arrays:
        return dict(arrays)


def part(golden, prefix: str, actor_loss: str = '') -> dict[str, np.ndarray]:
    """The arrays under a prefix; of the two runs, those with the given actor loss."""
    found = {}
    for name, array in golden.items():
        if name.startswith(f'{prefix}.'):
            name = name.removeprefix(f'{prefix}.').replace(f'actor_{actor_loss}.', 'actor.')
            if not name.startswith(('actor_ddpgbc.', 'actor_awr.')):
                found[name] = array
    return found


def make(golden, **settings):
    agent = make_agent(
        'gciql',
        obs_dim=golden['batch.observations'].shape[1],
        act_dim=golden['batch.actions'].shape[1],
        hidden=golden['meta.hidden_dims'],
        **{'alpha': float(golden['meta.alpha']), **settings},
    )
    agent.import_reference_parameters(part(golden, 'init'))
    return agent


def test_default_settings_are_those_of_the_reference(golden):
    settings = make_agent('gciql', obs_dim=2, act_dim=2).settings
    for name in ('discount', 'tau', 'expectile', 'alpha'):
        assert getattr(settings, name) == pytest.approx(float(golden[f'meta.{name}']))
    assert settings.actor_loss == 'ddpgbc'


def test_outputs_equal_the_reference(golden):
    agent = make(golden)
    batch = agent.tensors(part(golden, 'batch'))
    state, action = batch['observations'], batch['actions']
    value_goal, actor_goal = batch['value_goals'], batch['actor_goals']
    with torch.no_grad():
        log_prob, mean = agent.log_prob(state, actor_goal, action)
        pi_action = mean.clamp(-1, 1)

        def value(observations, goals):
            return agent.value(torch.cat([observations, goals], -1)).squeeze(-1)

        def critic(network, goals, actions):
            return network(torch.cat([state, goals, actions], -1)).squeeze(-1)

        outputs = {
            'actor_mean': mean,
            'log_prob': log_prob,
            'pi_action': pi_action,
            'v': value(state, value_goal),
            'next_v': value(batch['next_observations'], value_goal),
            'v_actor_goal': value(state, actor_goal),
        }
        for number in (1, 2):
            network, target = getattr(agent, f'critic{number}'), getattr(agent, f'target{number}')
            outputs[f'q{number}'] = critic(network, value_goal, action)
            outputs[f'q{number}_actor_goal'] = critic(network, actor_goal, action)
            outputs[f'q{number}_pi'] = critic(network, actor_goal, pi_action)
            outputs[f'target_q{number}'] = critic(target, value_goal, action)
    for name, output in outputs.items():
        np.testing.assert_allclose(
            output, golden[f'out.{name}'], rtol=1e-5, atol=5e-5, err_msg=name
        )
    values = agent.value_fn(golden['batch.observations'], golden['batch.value_goals'][0])
    same_goal = np.tile(golden['batch.value_goals'][0], (64, 1))
    with torch.no_grad():
        expected = value(state, torch.from_numpy(same_goal))
    np.testing.assert_allclose(values, expected, rtol=1e-6)
    assert values[0] == pytest.approx(golden['out.v'][0], rel=1e-5, abs=5e-5)


@ACTOR_LOSSES
def test_losses_equal_the_reference(golden, actor_loss):
    agent = make(golden, actor_loss=actor_loss)
    batch = agent.tensors(part(golden, 'batch'))
    total, parts = agent.losses(batch)
    assert total.item() == pytest.approx(golden[f'loss.total_{actor_loss}'], rel=1e-5)
    for name, key in {
        'value': 'value',
        'critic': 'critic',
        'actor': f'actor_{actor_loss}',
    }.items():
        assert parts[name].item() == pytest.approx(golden[f'loss.{key}'], rel=1e-5), name
    assert parts['bc'].item() == pytest.approx(golden['loss.bc'], rel=1e-5)
    if actor_loss == 'ddpgbc':
        assert parts['q'].item() == pytest.approx(golden['loss.ddpgbc_q_term'], rel=1e-5)
    alone, _ = agent.losses(batch, actor_only=True)
    assert alone.item() == pytest.approx(golden[f'loss.actor_{actor_loss}'], rel=1e-5)


@ACTOR_LOSSES
def test_actor_losses_at_other_alphas(golden, actor_loss):
    expected = golden[f'alt.{actor_loss}_loss']
    for alpha, loss in zip(golden[f'alt.{actor_loss}_alpha'], expected, strict=True):
        agent = make(golden, actor_loss=actor_loss, alpha=float(alpha))
        own, _ = agent.losses(agent.tensors(part(golden, 'batch')), actor_only=True)
        assert own.item() == pytest.approx(loss, rel=1e-5), alpha


def test_value_loss_at_other_expectiles(golden):
    expected = golden['alt.expectile_value_loss']
    for expectile, loss in zip(golden['alt.expectile'], expected, strict=True):
        agent = make(golden, expectile=float(expectile))
        _, parts = agent.losses(agent.tensors(part(golden, 'batch')))
        assert parts['value'].item() == pytest.approx(loss, rel=1e-5), expectile


def test_cloning_actor_loss(golden):
    agent = make(golden, actor_loss='bc')
    loss, _ = agent.losses(agent.tensors(part(golden, 'batch')), actor_only=True)
    assert loss.item() == pytest.approx(golden['loss.bc'], rel=1e-5)


@ACTOR_LOSSES
def test_gradients_equal_the_reference(golden, actor_loss):
    agent = make(golden, actor_loss=actor_loss)
    agent.losses(agent.tensors(part(golden, 'batch')))[0].backward()
    expected = part(golden, 'grad', actor_loss)
    for name, gradient in expected.items():
        own = agent.get_parameter(name.replace('kernel', 'weight').replace('scale', 'weight')).grad
        own = own.T if name.endswith('kernel') else own
        np.testing.assert_allclose(own, gradient, rtol=0, atol=5e-5, err_msg=name)
    assert len(expected) == len(list(agent.trained_parameters()))
    assert not any(
        weight.grad is not None
        for network in (agent.target1, agent.target2)
        for weight in network.parameters()
    )


@ACTOR_LOSSES
def test_adam_steps_equal_the_reference(golden, actor_loss):
    agent = make(golden, actor_loss=actor_loss)
    batch = agent.tensors(part(golden, 'batch'))
    parameters = list(agent.trained_parameters())
    optimizer = make_optimizer('adam', parameters, float(golden['meta.lr']))
    losses = []
    for step in range(1, 7):
        parts = agent.losses(batch)[1]
        losses.append([parts[name].item() for name in ('value', 'critic', 'actor')])
        if step == 6:
            break
        gradient_step(agent, optimizer, parameters, batch)
        expected = part(golden, f'adam{step}', actor_loss)
        exported = agent.export_reference_parameters()
        assert set(expected) == (set(exported) if step in (1, 5) else set())
        for name, weights in expected.items():
            tolerance = 1e-5 if step == 5 else 8e-7 if name.startswith('target') else 1e-6
            np.testing.assert_allclose(
                exported[name], weights, rtol=0, atol=tolerance, err_msg=f'{step} {name}'
            )
    keys = ('value', 'critic', f'actor_{actor_loss}')
    for column, key in zip(np.transpose(losses), keys, strict=True):
        np.testing.assert_allclose(column, golden[f'loss_traj.{key}'], rtol=1e-5, err_msg=key)


def test_actor_only_step_leaves_critics_and_targets(golden):
    agent = make(golden)
    before = weights_of(agent)
    parameters = list(agent.trained_parameters(actor_only=True))
    batch = agent.tensors(part(golden, 'batch'))
    optimizer = make_optimizer('adam', parameters, 1e-2)
    gradient_step(agent, optimizer, parameters, batch, actor_only=True)
    for name, weight in agent.state_dict().items():
        assert torch.equal(weight, before[name]) == (not name.startswith('actor.')), name


def test_fresh_targets_are_copies_and_critics_differ():
    agent = make_agent('gciql', obs_dim=2, act_dim=2, hidden=(8,))
    for number in (1, 2):
        critic = getattr(agent, f'critic{number}').state_dict()
        target = getattr(agent, f'target{number}').state_dict()
        assert all(torch.equal(target[name], critic[name]) for name in critic)
    assert not torch.equal(agent.critic1.fc0.weight, agent.critic2.fc0.weight)


def test_targets_move_by_tau():
    agent = tiny_agent('gciql', tau=0.25)
    critic, target = weights_of(agent.critic1), weights_of(agent.target1)
    agent.update_targets()
    for name, weight in agent.target1.state_dict().items():
        torch.testing.assert_close(weight, 0.25 * critic[name] + 0.75 * target[name])
    assert_bit_equal(agent.critic1, critic)


def test_value_function_is_equal_only_while_the_weights_stay():
    agent = tiny_agent('gciql')
    before = agent.value_fn
    assert before == agent.value_fn
    assert hash(before) == hash(agent.value_fn)
    assert agent.clone().value_fn != before
    parameters = list(agent.trained_parameters())
    optimizer = make_optimizer('adam', parameters, 1e-2)
    for parameter in parameters:
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    assert agent.value_fn != before
