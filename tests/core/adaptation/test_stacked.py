"""Tasks adapted together: each as if it were alone."""

import math

from metagcttt_core.adaptation.inner_loop import run_inner_loop
from metagcttt_core.adaptation.stacked import run_inner_loops
import numpy as np
import pytest
from tests.core.adaptation.test_inner_loop import batches_for
from tests.core.builders import assert_bit_equal, tiny_agent, weights_of
import torch

AGENTS = [
    ('gcbc', {}),
    ('gcbc', {'const_std': False}),
    ('gciql', {'actor_loss': 'bc'}),
    ('gciql', {'actor_loss': 'awr'}),
    ('gciql', {'actor_loss': 'ddpgbc'}),
    ('saw', {}),
    ('crl', {}),
    ('crl', {'actor_loss': 'awr'}),
    ('saw', {'const_std': False, 'alpha': 0.5}),
]
SIZES = [7, 16, 7, 3]  # of the test batches: two tasks share one


def tasks_for(agent, steps=8):
    train = [batches_for(agent, steps, seed=seed) for seed in range(len(SIZES))]
    test = [batches_for(agent, 1, size, seed=50 + size)[0] for size in SIZES]
    return train, test


def double(agent, batches):
    """In float64 round-off cannot turn the sign of a tiny Adam step."""
    return agent.double(), [
        [{k: v.double() for k, v in b.items()} for b in task] for task in batches
    ]


@pytest.mark.parametrize(('name', 'settings'), AGENTS)
@pytest.mark.parametrize('actor_only', [False, True])
@pytest.mark.parametrize(('optimizer', 'lr'), [('adam', 0.1), ('sgd', 0.3)])
def test_each_task_ends_as_if_adapted_alone(name, settings, actor_only, optimizer, lr):
    base = tiny_agent(name, **settings)
    train, test = tasks_for(base)
    base, train = double(base, train)
    _, (test,) = double(base, [test])
    settings = {'lr': lr, 'optimizer': optimizer, 'actor_only': actor_only}
    weights = weights_of(base)
    together = run_inner_loops(base, train, test_batches=test, **settings)
    alone = [
        run_inner_loop(base, batches, test_batch=test_batch, **settings)
        for batches, test_batch in zip(train, test, strict=True)
    ]
    assert_bit_equal(base, weights)
    assert len({result.best_step for result in alone}) > 1  # early stopping tells tasks apart
    for first, second in zip(together, alone, strict=True):
        assert first.best_step == second.best_step
        np.testing.assert_allclose(first.train_losses, second.train_losses, rtol=1e-9)
        np.testing.assert_allclose(first.test_losses, second.test_losses, rtol=1e-9)
        for key, weight in second.agent.state_dict().items():
            torch.testing.assert_close(first.agent.state_dict()[key], weight, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize('name', ['crl', 'gcbc', 'gciql', 'saw'])
def test_without_a_test_batch_every_step_counts(name):
    base = tiny_agent(name)
    train, _ = tasks_for(base)
    together = run_inner_loops(base, train, lr=1e-3)
    for result, batches in zip(together, train, strict=True):
        alone = run_inner_loop(base, batches, lr=1e-3)
        assert (result.best_step, result.test_losses) == (8, [])
        np.testing.assert_allclose(result.train_losses, alone.train_losses, rtol=1e-4)
        for key, weight in alone.agent.state_dict().items():
            torch.testing.assert_close(
                result.agent.state_dict()[key], weight, rtol=1e-4, atol=1e-5
            )


def test_tasks_do_not_see_each_other():
    """A task that overflows takes no other along, and keeps the base weights itself."""
    base = tiny_agent()
    train, test = tasks_for(base)
    expected = run_inner_loops(base, train, lr=0.05, test_batches=test)
    for batch in train[1]:
        batch['actions'] = batch['actions'] * 1e30
    spoiled = run_inner_loops(base, train, lr=0.05, test_batches=test)
    assert spoiled[1].best_step == 0
    assert not math.isfinite(spoiled[1].train_losses[0])
    assert_bit_equal(spoiled[1].agent, weights_of(base))
    for task in (0, 2, 3):
        assert_bit_equal(spoiled[task].agent, weights_of(expected[task].agent))
        assert spoiled[task].test_losses == expected[task].test_losses


def test_rejected_tasks_keep_the_base_weights_and_earliest_step_wins_ties():
    base = tiny_agent()
    train, test = tasks_for(base)
    for batch in train[2]:  # its gradient is zero: every step has the same test loss
        batch['actions'] = base.log_prob(
            batch['observations'], batch['actor_goals'], batch['actions']
        )[1].detach()
    result = run_inner_loops(base, train, lr=1e-12, test_batches=test, optimizer='sgd')[2]
    assert result.best_step == 0
    assert_bit_equal(result.agent, weights_of(base))


def test_experts_share_no_memory_with_base_or_each_other():
    base = tiny_agent('gciql')
    train, test = tasks_for(base, steps=2)
    agents = [base, *(r.agent for r in run_inner_loops(base, train, lr=0.1, test_batches=test))]
    pointers = [weight.data_ptr() for agent in agents for weight in agent.parameters()]
    assert len(set(pointers)) == len(pointers)
    assert [weight.requires_grad for weight in agents[1].parameters()] == [
        weight.requires_grad for weight in base.parameters()
    ]


def test_tasks_with_unequal_numbers_of_steps_are_refused():
    base = tiny_agent()
    train, _ = tasks_for(base)
    with pytest.raises(ValueError, match='shorter'):
        run_inner_loops(base, [train[0], train[1][:3]], lr=0.1)
