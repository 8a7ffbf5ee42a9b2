"""The meta-updates on tiny weights, by hand."""

import copy

from metagcttt_core import MetaConfig
from metagcttt_core.adaptation.result import Adaptation
from metagcttt_core.meta.experts import Expert
from metagcttt_core.meta.registry import GRADIENT_UPDATES, META_UPDATES
from metagcttt_core.meta.updates import continual, fomaml, reptile
from metagcttt_core.training.optimizers import make_optimizer
import numpy as np
import pytest
from tests.core.builders import assert_bit_equal, tiny_agent, weights_of
import torch

CONFIG = MetaConfig(algorithm='reptile', meta_lr=0.25)


def constant(value: float, name: str = 'gcbc'):
    """An agent whose every weight has one value."""
    agent = tiny_agent(name)
    with torch.no_grad():
        for weight in agent.state_dict().values():
            weight.fill_(value)
    return agent


def expert_of(agent, best_step: int = 1, test_batch=None) -> Expert:
    return Expert(Adaptation(agent, [0.0], [0.0], best_step), test_batch, lambda: [])


def held_out_batch(agent, seed: int = 0):
    rng = np.random.default_rng(seed)
    return agent.tensors(
        {
            'observations': rng.normal(size=(5, 2)).astype(np.float32),
            'actor_goals': rng.normal(size=(5, 2)).astype(np.float32),
            'actions': rng.uniform(-1, 1, size=(5, 2)).astype(np.float32),
        }
    )


def assert_constant(agent, value: float) -> None:
    for weight in agent.state_dict().values():
        torch.testing.assert_close(weight, torch.full_like(weight, value))


@pytest.mark.parametrize('name', ['crl', 'gcbc', 'gciql', 'saw'])
@pytest.mark.parametrize(('adapted', 'expected'), [([5.0], 5.0), ([2.0, 4.0, 9.0], 5.0)])
def test_continual_takes_the_mean_of_the_adapted_weights(name, adapted, expected):
    base = constant(1.0, name)
    continual(base, [expert_of(constant(value, name)) for value in adapted], CONFIG)
    assert_constant(base, expected)


@pytest.mark.parametrize('name', ['crl', 'gcbc', 'gciql', 'saw'])
@pytest.mark.parametrize('adapted', [[5.0], [2.0, 4.0, 9.0]])
def test_reptile_moves_by_beta_towards_the_mean(name, adapted):
    base = constant(1.0, name)
    reptile(base, [expert_of(constant(value, name)) for value in adapted], CONFIG)
    assert_constant(base, 1 + 0.25 * (5 - 1))


def test_reptile_with_beta_one_is_continual():
    experts = [expert_of(tiny_agent(seed=seed)) for seed in (1, 2, 3)]
    bases = [tiny_agent(), tiny_agent()]
    continual(bases[0], experts, CONFIG)
    reptile(bases[1], experts, MetaConfig(algorithm='reptile', meta_lr=1.0))
    for name, weight in bases[0].state_dict().items():
        torch.testing.assert_close(bases[1].state_dict()[name], weight)


@pytest.mark.parametrize('update', [continual, reptile])
@pytest.mark.parametrize('size', [1, 3])
def test_rejected_inner_loops_change_nothing(update, size):
    """k* = 0: every expert has the base weights."""
    base = tiny_agent('gciql')
    weights = weights_of(base)
    update(base, [expert_of(base.clone(), best_step=0) for _ in range(size)], CONFIG)
    assert_bit_equal(base, weights)


def test_one_rejected_inner_loop_of_three_counts_as_the_base():
    experts = [expert_of(constant(1.0), best_step=0), *map(expert_of, map(constant, (4.0, 7.0)))]
    base = constant(1.0)
    continual(base, experts, CONFIG)
    assert_constant(base, 4.0)
    base = constant(1.0)
    reptile(base, experts, CONFIG)
    assert_constant(base, 1.75)


@pytest.mark.parametrize('update', [continual, reptile])
def test_merging_leaves_the_experts_alone(update):
    adapted = [tiny_agent(seed=seed) for seed in (1, 2)]
    before = [weights_of(agent) for agent in adapted]
    base = tiny_agent()
    update(base, [expert_of(agent) for agent in adapted], CONFIG)
    with torch.no_grad():
        for weight in base.parameters():
            weight.add_(1)
    for agent, weights in zip(adapted, before, strict=True):
        assert_bit_equal(agent, weights)


def test_single_expert_is_copied_not_shared():
    base, adapted = tiny_agent(), tiny_agent(seed=1)
    continual(base, [expert_of(adapted)], CONFIG)
    assert_bit_equal(base, weights_of(adapted))
    assert base.actor.mean.bias.data_ptr() != adapted.actor.mean.bias.data_ptr()


def fomaml_step(experts, **settings):
    """The weights of a constant base after one step of TT-FOMAML."""
    base = constant(1.0)
    config = MetaConfig(algorithm='fomaml', **settings)
    optimizer = make_optimizer('sgd', base.trained_parameters(), 0.1)
    fomaml(base, experts, config, optimizer)
    return weights_of(base)


def test_fomaml_leaves_rejected_tasks_out_of_the_mean_on_request():
    agents = [tiny_agent(seed=seed) for seed in (1, 2, 3)]
    batches = [held_out_batch(agent, seed) for seed, agent in enumerate(agents)]

    def experts(*best_steps):
        return [
            expert_of(agent, k, batch)
            for agent, k, batch in zip(agents, best_steps, batches, strict=False)
        ]

    taken = fomaml_step(experts(4, 0, 2))
    left_out = fomaml_step(experts(4, 0, 2), rejected='reject')
    without = [expert for expert in experts(4, 0, 2) if expert.result.accepted]
    assert_close(left_out, fomaml_step(without))
    with pytest.raises(AssertionError):
        assert_close(left_out, taken)
    assert_bit_equal(constant(1.0), fomaml_step(experts(0, 0, 0), rejected='reject'))
    with pytest.raises(AssertionError):
        assert_bit_equal(constant(1.0), fomaml_step(experts(0, 0, 0)))


def assert_close(weights, others):
    for weight, other in zip(weights.values(), others.values(), strict=True):
        torch.testing.assert_close(weight, other)


@pytest.mark.parametrize('size', [1, 3])
def test_fomaml_gradient_by_hand(size):
    """The bias of the mean head has the gradient mean(m - a), taken at the adapted weights."""
    base = tiny_agent()
    start = base.actor.mean.bias.detach().clone()
    experts, gradients = [], []
    for seed in range(1, size + 1):
        adapted = tiny_agent(seed=seed)
        batch = held_out_batch(adapted, seed)
        experts.append(expert_of(adapted, test_batch=batch))
        with torch.no_grad():
            inputs = torch.cat([batch['observations'], batch['actor_goals']], -1)
            gradients.append((adapted.actor(inputs) - batch['actions']).mean(0))
    mean = torch.stack(gradients).mean(0)
    # With plain gradient descent of rate 1 the step is the gradient itself.
    fomaml(base, experts, CONFIG, torch.optim.SGD(base.parameters(), lr=1.0))
    torch.testing.assert_close(base.actor.mean.bias.detach(), start - mean)
    # With a fresh Adam it is beta times the sign.
    base = tiny_agent()
    fomaml(base, experts, CONFIG, make_optimizer('adam', base.parameters(), 0.25))
    torch.testing.assert_close(
        base.actor.mean.bias.detach(), start - 0.25 * mean / (mean.abs() + 1e-8)
    )


@pytest.mark.parametrize('size', [1, 3])
def test_fomaml_equals_a_detached_reference_over_several_outer_steps(size):
    """Theta <- Adam(theta, mean of the test-loss gradients at the detached adapted weights)."""
    base, meta_lr = tiny_agent(), 0.03
    reference = base.clone()
    optimizer = make_optimizer('adam', base.parameters(), meta_lr)
    reference_optimizer = torch.optim.Adam(reference.parameters(), lr=meta_lr)
    for outer in range(4):
        adapted = [tiny_agent(seed=10 * outer + number) for number in range(size)]
        batches = [held_out_batch(agent, seed=outer) for agent in adapted]
        experts = [
            expert_of(agent, test_batch=batch)
            for agent, batch in zip(adapted, batches, strict=True)
        ]
        fomaml(base, experts, CONFIG, optimizer)
        reference_optimizer.zero_grad()
        for agent, batch in zip(adapted, batches, strict=True):
            detached = copy.deepcopy(agent)
            (detached.losses(batch)[0] / size).backward()
            for weight, own in zip(reference.parameters(), detached.parameters(), strict=True):
                weight.grad = own.grad.clone() if weight.grad is None else weight.grad + own.grad
        reference_optimizer.step()
        for own, expected in zip(base.parameters(), reference.parameters(), strict=True):
            torch.testing.assert_close(own, expected, rtol=1e-5, atol=1e-6)


def test_fomaml_leaves_the_experts_alone():
    base, adapted = tiny_agent(), tiny_agent(seed=1)
    weights = weights_of(adapted)
    experts = [expert_of(adapted, test_batch=held_out_batch(adapted))]
    fomaml(base, experts, CONFIG, make_optimizer('adam', base.parameters(), 0.1))
    assert_bit_equal(adapted, weights)
    assert all(weight.grad is None for weight in adapted.parameters())


def test_fomaml_of_the_actor_alone_leaves_the_critics():
    base = tiny_agent('gciql', actor_loss='bc')
    weights = weights_of(base)
    adapted = tiny_agent('gciql', seed=1, actor_loss='bc')
    config = MetaConfig(actor_only=True)
    optimizer = make_optimizer('adam', base.trained_parameters(actor_only=True), 0.1)
    fomaml(base, [expert_of(adapted, test_batch=held_out_batch(base))], config, optimizer)
    for name, weight in base.state_dict().items():
        assert torch.equal(weight, weights[name]) == (not name.startswith('actor.')), name


def test_fomaml_of_the_whole_agent_moves_the_target_critics_like_any_gradient_step():
    """By tau towards the critics as they were before the outer step."""
    base = tiny_agent('gciql', actor_loss='bc', tau=0.25)
    pairs = zip(base.target1.parameters(), base.critic1.parameters(), strict=True)
    expected = [(0.75 * target + 0.25 * critic).detach() for target, critic in pairs]
    batch = held_out_batch(base)
    extra = {'next_observations': batch['observations'], 'value_goals': batch['actor_goals']}
    extra |= {'rewards': -torch.ones(5), 'masks': torch.ones(5)}
    expert = expert_of(tiny_agent('gciql', seed=1, actor_loss='bc'), test_batch=batch | extra)
    optimizer = make_optimizer('adam', base.trained_parameters(), 0.1)
    fomaml(base, [expert], CONFIG, optimizer)
    for target, wanted in zip(base.target1.parameters(), expected, strict=True):
        torch.testing.assert_close(target.detach(), wanted)


def test_fomaml_without_an_outer_optimizer_is_refused():
    base = tiny_agent()
    with pytest.raises(ValueError, match='fomaml needs an outer optimizer'):
        expert = expert_of(base.clone(), test_batch=held_out_batch(base))
        fomaml(base, [expert], CONFIG.model_copy(update={'algorithm': 'fomaml'}), None)


def test_rejected_fomaml_inner_loop_takes_the_gradient_at_the_base():
    """k* = 0 rejects nothing here: theta itself is where the gradient is taken."""
    base = tiny_agent()
    batch = held_out_batch(base)
    gradients = torch.autograd.grad(base.losses(batch)[0], list(base.parameters()))
    before = [weight.detach().clone() for weight in base.parameters()]
    experts = [expert_of(base.clone(), best_step=0, test_batch=batch)]
    fomaml(base, experts, CONFIG, torch.optim.SGD(base.parameters(), lr=0.5))
    for weight, start, gradient in zip(base.parameters(), before, gradients, strict=True):
        torch.testing.assert_close(weight.detach(), start - 0.5 * gradient)


def test_every_update_is_registered_by_its_name():
    for name, update in META_UPDATES.items():
        assert update.__name__ == name
        assert MetaConfig(algorithm=name).algorithm == name
    assert {'continual', 'fomaml', 'reptile'} <= META_UPDATES.keys()
    assert 'fomaml' in GRADIENT_UPDATES
    assert not GRADIENT_UPDATES & {'continual', 'reptile'}
