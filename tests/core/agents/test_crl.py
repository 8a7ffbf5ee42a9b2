"""CRL against losses computed one pair at a time."""

import math

from metagcttt_core import adapt, FilterConfig, make_agent, TrajectoryFilter, TTTConfig
from metagcttt_core.data.relabel import GoalConfig, GoalDistribution
from metagcttt_core.training.config import PretrainConfig
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.pretrain import pretrain
from metagcttt_core.training.step import gradient_step
import numpy as np
import pytest
from tests.core.agents.slow import batch_of, SlowNetworks
from tests.core.builders import dataset_at, random_dataset, tiny_agent, weights_of
import torch


class Slow(SlowNetworks):
    """Networks and losses for one pair at a time, from exported arrays."""

    def score(self, net, x, g):
        phi, psi = (
            self.mlp(f'{net}.{n}', y, 'out', norm=True) for n, y in (('phi', x), ('psi', g))
        )
        return sum(p * q for p, q in zip(phi, psi, strict=True)) / math.sqrt(len(phi))

    def q(self, s, g, a):
        x = np.concatenate([s, a])
        return min(self.score('critic1', x, g), self.score('critic2', x, g))

    def v(self, s, g):
        if self.s.actor_loss == 'awr':
            return self.score('value', s, g)
        return self.q(s, g, np.clip(self.mean(s, g), -1, 1))

    def mean(self, s, g):
        return self.mlp('actor', np.concatenate([s, g]), 'mean', norm=False)

    def contrast(self, net, inputs, goals):
        """The mean of -log P(is the row's own) or -log P(is not) over all pairs."""
        total = 0.0
        for i, x in enumerate(inputs):
            for j, g in enumerate(goals):
                own = 1 / (1 + math.exp(-self.score(net, x, g)))
                total -= math.log(own if i == j else 1 - own)
        return total / len(inputs) ** 2

    def log_prob(self, s, g, a):
        std = np.exp(np.clip(self.w.get('actor.log_stds', np.zeros(len(a))), -5, 2))
        density = np.exp(-0.5 * ((a - self.mean(s, g)) / std) ** 2) / (
            std * math.sqrt(2 * math.pi)
        )
        return math.log(np.prod(density))

    def actor(self, s, g, a):
        """The actor loss of the rows of a batch."""
        rows = list(zip(s, g, a, strict=True))
        cloned = np.array([self.log_prob(*row) for row in rows])
        if self.s.actor_loss == 'ddpgbc':
            qs = np.array([self.q(x, y, np.clip(self.mean(x, y), -1, 1)) for x, y, _ in rows])
            return -qs.mean() / (np.abs(qs).mean() + 1e-6) - self.s.alpha * cloned.mean()
        if self.s.actor_loss == 'bc':
            return -cloned.mean()
        weights = [
            min(math.exp(self.s.alpha * (self.q(x, y, z) - self.v(x, y))), 100) for x, y, z in rows
        ]
        return -(weights * cloned).mean()


@pytest.mark.parametrize(
    'settings',
    [
        {},
        {'alpha': 0.7, 'const_std': False, 'latent_dim': 9},
        {'actor_loss': 'awr', 'alpha': 3.0, 'hidden': (7, 5)},
        {'actor_loss': 'bc'},
    ],
)
def test_losses_equal_a_reference_of_single_pairs(settings):
    agent = tiny_agent('crl', obs_dim=3, **settings)
    batch = batch_of(agent, 24)
    s, a, g = batch['observations'], batch['actions'], batch['actor_goals']
    slow, with_actions = Slow(agent), np.concatenate([s, a], axis=1)
    nets = ('critic1', 'critic2')
    expected = {
        'critic': np.mean([slow.contrast(n, with_actions, batch['value_goals']) for n in nets]),
        'actor': slow.actor(s, g, a),
    }
    if agent.settings.actor_loss == 'awr':
        expected['value'] = slow.contrast('value', s, batch['value_goals'])
    total, parts = agent.losses(agent.tensors(batch))
    for name, value in expected.items():
        assert parts[name].item() == pytest.approx(value, rel=1e-4), name
    assert ('value' in parts) == ('value' in expected)
    assert total.item() == pytest.approx(sum(expected.values()), rel=1e-4)
    actor_loss, actor_parts = agent.losses(agent.tensors(batch), actor_only=True)
    assert actor_loss.item() == pytest.approx(expected['actor'], rel=1e-4)
    assert not {'value', 'critic'} & actor_parts.keys()
    values = agent.value_fn(s, g[0])
    np.testing.assert_allclose(values, [slow.v(x, g[0]) for x in s], rtol=1e-4, atol=1e-5)


def test_default_settings_are_those_of_ogbench():
    settings = make_agent('crl', obs_dim=2, act_dim=2, hidden=(8,)).settings
    assert (settings.actor_loss, settings.alpha, settings.discount) == ('ddpgbc', 0.1, 0.99)
    assert (settings.latent_dim, settings.const_std) == (512, True)
    later = GoalDistribution(p_curgoal=0, p_trajgoal=1, p_randomgoal=0, geometric=True)
    assert settings.goals == GoalConfig(value=later)


@pytest.mark.parametrize('actor_loss', ['ddpgbc', 'awr'])
@pytest.mark.parametrize('actor_only', [True, False])
def test_step_moves_what_it_trains(actor_only, actor_loss):
    agent = tiny_agent('crl', actor_loss=actor_loss)
    before = weights_of(agent)
    parameters = list(agent.trained_parameters(actor_only=actor_only))
    optimizer = make_optimizer('adam', parameters, 1e-2)
    batch = agent.tensors(batch_of(agent, 24))
    gradient_step(agent, optimizer, parameters, batch, actor_only=actor_only)
    after = agent.state_dict()
    moved = {name.split('.')[0] for name in before if not torch.equal(before[name], after[name])}
    others = {'critic1', 'critic2', *(['value'] if actor_loss == 'awr' else [])}
    assert moved == {'actor'} | (set() if actor_only else others)


def test_critics_do_not_learn_from_the_actor_loss():
    agent = tiny_agent('crl')
    loss, _ = agent.losses(agent.tensors(batch_of(agent, 24)), actor_only=True)
    loss.backward()
    got = {
        name.split('.')[0] for name, weight in agent.named_parameters() if weight.grad is not None
    }
    assert got == {'actor'}


def test_value_function_is_equal_only_while_the_weights_stay():
    for settings, network in (({}, 'actor'), ({}, 'critic2'), ({'actor_loss': 'awr'}, 'value')):
        agent = tiny_agent('crl', **settings)
        before = agent.value_fn
        assert before == agent.value_fn
        with torch.no_grad():
            next(getattr(agent, network).parameters()).add_(1)
        assert agent.value_fn != before


@pytest.mark.parametrize('goals', [{'value': None}, {'gc_negative': False}])
def test_goals_without_a_meaning_are_refused(goals):
    with pytest.raises(ValueError, match=r'CRL needs goals\.value, and goals\.gc_negative has no'):
        make_agent('crl', obs_dim=2, act_dim=2, goals=goals)


@pytest.mark.parametrize('actor_only', [True, False])
def test_test_time_training_lowers_the_loss_on_the_support(actor_only):
    agent, dataset = tiny_agent('crl', hidden=(16,)), random_dataset([30, 30])
    state, goal = dataset.observations[3], dataset.observations[20]
    support = TrajectoryFilter(dataset, FilterConfig(epsilon=4.0, top_percent=100)).query(
        state, goal, agent.value_fn
    )
    config = TTTConfig(steps=60, lr=3e-3, batch_size=64, actor_only=actor_only)
    result = adapt(agent, dataset, support, goal, config)
    assert result.accepted
    assert np.mean(result.train_losses[-10:]) < np.mean(result.train_losses[:10])


def test_critic_scores_what_leads_to_a_goal_above_what_does_not():
    """After a short training, V grows along the way to a goal and falls behind it."""
    dataset = dataset_at([np.linspace(-2, 2, 60)[:, None]])
    agent = make_agent('crl', obs_dim=1, act_dim=2, hidden=(32,), latent_dim=16, discount=0.8)
    agent = pretrain(agent, dataset, PretrainConfig(steps=60, batch_size=64, lr=1e-2))
    values = agent.value_fn(dataset.observations, dataset.observations[30])
    assert values[28] > values[20] > values[10]
    assert values[32] > values[45] > values[58]
    assert values[20] > values[40]
