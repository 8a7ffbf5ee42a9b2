"""SAW against losses computed one transition at a time, and its waypoints."""

import math

from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from metagcttt_core import adapt, FilterConfig, make_agent, TrajectoryFilter, TTTConfig
from metagcttt_core.adaptation.batches import QueryBatches
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.step import gradient_step
import numpy as np
import pytest
from tests.core.agents.slow import batch_of, SlowNetworks
from tests.core.builders import dataset_at, random_dataset, tiny_agent, weights_of
import torch


class Slow(SlowNetworks):
    """Networks and losses for one transition at a time, from exported arrays."""

    def rep(self, net, s, g):
        out = self.mlp(net, np.concatenate([s, g]), 'out', norm=True)
        return out / math.sqrt((out**2).sum()) * math.sqrt(len(out))

    def twins(self, kind, s, g):
        x = np.concatenate([s, self.rep('value_rep', s, g)])
        return [self.mlp(f'{kind}{n}', x, 'out', norm=True)[0] for n in (1, 2)]

    def value(self, s, g):
        return sum(self.twins('value', s, g)) / 2

    def actor(self, s, g):
        x = np.concatenate([s, self.rep('actor.goal_rep', s, g)])
        return self.mlp('actor', x, 'mean', norm=False)

    def subpolicy(self, s, w):
        return self.mlp('subpolicy', np.concatenate([s, w]), 'mean', norm=False)

    def log_std(self, net):
        return np.clip(self.w.get(f'{net}.log_stds', np.zeros(2)), -5, 2)

    def log_prob(self, net, mean, action):
        std = np.exp(self.log_std(net))
        density = np.exp(-0.5 * ((action - mean) / std) ** 2) / (std * math.sqrt(2 * math.pi))
        return math.log(np.prod(density))

    def value_loss(self, s, n, g, r, m):
        targets, nexts = self.twins('target', s, g), self.twins('target', n, g)
        advantage = r + self.s.discount * m * min(nexts) - sum(targets) / 2
        side = self.s.expectile if advantage >= 0 else 1 - self.s.expectile
        values = self.twins('value', s, g)
        return sum(
            side * (r + self.s.discount * m * after - value) ** 2
            for value, after in zip(values, nexts, strict=True)
        )

    def weight(self, alpha, here, there, g):
        return min(math.exp(alpha * (self.value(there, g) - self.value(here, g))), 100)

    def subpolicy_loss(self, s, n, w, a):
        log_prob = self.log_prob('subpolicy', self.subpolicy(s, w), a)
        return -self.weight(self.s.subpolicy_alpha, s, n, w) * log_prob

    def awr(self, s, n, g, a):
        log_prob = self.log_prob('actor', self.actor(s, g), a)
        return -self.weight(self.s.alpha, s, n, g) * log_prob

    def waypoint(self, s, w, g):
        mean, other = self.actor(s, g), self.subpolicy(s, w)
        divergence = ((mean - other) ** 2).sum()
        if not self.s.const_std:
            own, theirs = np.exp(self.log_std('actor')), np.exp(self.log_std('subpolicy'))
            divergence = sum(
                math.log(p / q) + (q**2 + (x - y) ** 2) / (2 * p**2) - 0.5
                for p, q, x, y in zip(own, theirs, mean, other, strict=True)
            )
        return self.weight(self.s.waypoint_alpha, s, w, g) * divergence


@pytest.mark.parametrize(
    'settings',
    [
        {},
        {'const_std': False},
        {'hidden': (7, 5), 'rep_dim': 3},
        {'alpha': 0.5, 'subpolicy_alpha': 9.0, 'waypoint_alpha': 30.0, 'expectile': 0.9},
    ],
)
def test_losses_equal_a_reference_of_single_transitions(settings):
    agent = tiny_agent('saw', obs_dim=3, **settings)
    batch = batch_of(agent, 32)
    s, n, a = batch['observations'], batch['next_observations'], batch['actions']
    goals, way, sub = batch['actor_goals'], batch['waypoints'], batch['subgoals']
    slow, size = Slow(agent), range(len(s))
    terms = {
        'value': [
            slow.value_loss(s[i], n[i], batch['value_goals'][i], batch['rewards'][i], m)
            for i, m in enumerate(batch['masks'])
        ],
        'subpolicy': [slow.subpolicy_loss(s[i], n[i], sub[i], a[i]) for i in size],
        'awr': [slow.awr(s[i], n[i], goals[i], a[i]) for i in size],
        'waypoint': [slow.waypoint(s[i], way[i], goals[i]) for i in size],
    }
    expected = {name: np.mean(values) for name, values in terms.items()}
    total, parts = agent.losses(agent.tensors(batch))
    for name, value in expected.items():
        assert parts[name].item() == pytest.approx(value, rel=1e-4), name
    assert total.item() == pytest.approx(sum(expected.values()), rel=1e-4)
    actor_loss, actor_parts = agent.losses(agent.tensors(batch), actor_only=True)
    assert actor_loss.item() == pytest.approx(expected['awr'] + expected['waypoint'], rel=1e-4)
    assert not {'value', 'subpolicy'} & actor_parts.keys()
    values = agent.value_fn(s, goals[0])
    np.testing.assert_allclose(values, [slow.value(x, goals[0]) for x in s], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(
        agent.act(s[0], goals[0]), np.clip(slow.actor(s[0], goals[0]), -1, 1), rtol=1e-4, atol=1e-6
    )


def test_default_settings_are_those_of_the_authors():
    settings = make_agent('saw', obs_dim=2, act_dim=2).settings
    assert (settings.expectile, settings.tau, settings.discount) == (0.7, 0.005, 0.99)
    assert (settings.alpha, settings.subpolicy_alpha, settings.waypoint_alpha) == (3, 3, 3)
    assert (settings.subgoal_steps, settings.rep_dim, settings.const_std) == (25, 10, True)
    assert settings.hidden == (512, 512, 512)


@pytest.mark.parametrize(
    ('part', 'trained'),
    [
        ('value', {'value1', 'value2', 'value_rep'}),
        ('subpolicy', {'subpolicy'}),
        ('actor', {'actor'}),
    ],
)
def test_each_loss_trains_its_own_networks(part, trained):
    agent = tiny_agent('saw', const_std=False)
    batch = agent.tensors(batch_of(agent, 32))
    loss = getattr(agent, f'_{part}_loss')(batch)
    (loss[0] if part == 'actor' else loss).backward()
    got = {n.split('.')[0] for n, w in agent.named_parameters() if w.grad is not None}
    assert got == trained


@pytest.mark.parametrize('actor_only', [True, False])
def test_step_moves_what_it_trains(actor_only):
    agent = tiny_agent('saw', tau=0.25)
    before = weights_of(agent)
    parameters = list(agent.trained_parameters(actor_only=actor_only))
    batch = agent.tensors(batch_of(agent, 32))
    agent.value1.out.bias.data += 1  # targets trail values that are elsewhere
    trailed = agent.target1.out.bias + 0.25 * (agent.value1.out.bias - agent.target1.out.bias)
    gradient_step(
        agent, make_optimizer('adam', parameters, 1e-2), parameters, batch, actor_only=actor_only
    )
    moved = {
        name.split('.')[0]
        for name, weight in agent.state_dict().items()
        if name != 'value1.out.bias' and not torch.equal(weight, before[name])
    }
    if actor_only:
        assert moved == {'actor'}
    else:
        names = {'actor', 'subpolicy', 'value_rep', 'value1', 'value2', 'target1', 'target2'}
        assert moved == names
        torch.testing.assert_close(agent.target1.out.bias, trailed)


@given(
    lengths=st.lists(st.integers(2, 30), min_size=1, max_size=5),
    steps=st.integers(1, 40),
    p_random=st.floats(0, 1),
    seed=st.integers(0, 2**32 - 1),
)
@hypothesis_settings(deadline=None, max_examples=60)
def test_waypoints_lie_on_the_way_to_the_goal(lengths, steps, p_random, seed):
    numbers = np.arange(sum(lengths))[:, None]
    ends = np.cumsum(lengths)
    dataset = dataset_at(np.split(numbers, ends[:-1]))
    goals = {'actor': {'p_trajgoal': 1 - p_random, 'p_randomgoal': p_random}}
    agent = make_agent('saw', obs_dim=1, act_dim=2, hidden=(2,), subgoal_steps=steps, goals=goals)
    batch = agent.relabeller(dataset).sample(50, np.random.default_rng(seed))
    names = ('observations', 'subgoals', 'waypoints', 'actor_goals')
    rows, subgoals, waypoints, goal_rows = (batch[name][:, 0].astype(int) for name in names)
    for row, subgoal, waypoint, goal in zip(rows, subgoals, waypoints, goal_rows, strict=True):
        last = min(end for end in ends if end > row) - 2  # the final row is never a goal
        assert subgoal == min(row + steps, last)
        assert waypoint == (min(subgoal, goal) if row <= goal <= last else subgoal)


def test_waypoint_of_a_query_is_not_cut_at_another_goal():
    dataset = dataset_at([np.arange(40)[:, None]])
    agent = make_agent('saw', obs_dim=1, act_dim=2, hidden=(2,), subgoal_steps=10)
    batches = QueryBatches(agent, dataset, np.arange(20), np.array([-7.0]), fix_actor_goal=0.5)
    batch = {
        k: v.numpy()[:, 0]
        for k, v in batches.sample(200, np.random.default_rng(0)).items()
        if v.ndim == 2
    }
    fixed = batch['actor_goals'] == -7
    assert 0 < fixed.sum() < 200
    np.testing.assert_array_equal(batch['waypoints'][fixed], batch['observations'][fixed] + 10)
    assert (batch['waypoints'][~fixed] <= batch['actor_goals'][~fixed]).all()
    assert (batch['waypoints'][~fixed] < batch['observations'][~fixed] + 10).any()


@given(scale=st.floats(1e-3, 1e3), seed=st.integers(0, 1000))
@hypothesis_settings(deadline=None, max_examples=30)
def test_goal_representations_have_length_sqrt_of_their_width(scale, seed):
    agent = tiny_agent('saw', rep_dim=10)
    generator = torch.Generator().manual_seed(seed)
    inputs = scale * torch.randn(8, 4, generator=generator)
    for rep in (agent.value_rep, agent.actor.goal_rep):
        torch.testing.assert_close(rep(inputs).norm(dim=-1), torch.full((8,), math.sqrt(10)))


def test_fresh_agent_is_finite_where_state_and_goal_are_zero():
    agent = make_agent('saw', obs_dim=2, act_dim=2, hidden=(8,))
    assert np.isfinite(agent.act(np.zeros(2), np.zeros(2))).all()
    assert np.isfinite(agent.value_fn(np.zeros((1, 2)), np.zeros(2))).all()


def test_value_function_is_equal_only_while_the_weights_stay():
    agent = tiny_agent('saw')
    before = agent.value_fn
    assert before == agent.value_fn
    with torch.no_grad():
        agent.value_rep.out.bias.add_(1)
    assert agent.value_fn != before


@pytest.mark.parametrize('actor_only', [True, False])
def test_test_time_training_lowers_the_loss_on_the_support(actor_only):
    agent, dataset = tiny_agent('saw', hidden=(16,)), random_dataset([30, 30])
    state, goal = dataset.observations[3], dataset.observations[20]
    support = TrajectoryFilter(dataset, FilterConfig(epsilon=4.0, top_percent=100)).query(
        state, goal, agent.value_fn
    )
    config = TTTConfig(steps=60, lr=3e-3, batch_size=64, actor_only=actor_only)
    result = adapt(agent, dataset, support, goal, config)
    assert result.accepted
    assert np.mean(result.train_losses[-10:]) < np.mean(result.train_losses[:10])
