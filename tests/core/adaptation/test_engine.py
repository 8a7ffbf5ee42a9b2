"""The analytic engine equals the eager one over K steps, and gives way to it where it must."""

from metagcttt_core import adapt
from metagcttt_core.adaptation.engine import make_engine
from metagcttt_core.adaptation.inner_loop import run_inner_loop
from metagcttt_core.agents import GCBC
from metagcttt_core.training.optimizers import make_optimizer
import numpy as np
import pytest
from tests.core.adaptation.test_adapt import GOAL, quick, support_of
from tests.core.adaptation.test_inner_loop import batches_for
from tests.core.agents.test_analytic import LEARNERS
from tests.core.builders import assert_bit_equal, random_dataset, tiny_agent, weights_of
import torch

STEPS = 10


def largest_difference(first, second) -> float:
    return max(
        (a - b).abs().max().item()
        for a, b in zip(first.agent.parameters(), second.agent.parameters(), strict=True)
    )


@LEARNERS
@pytest.mark.parametrize('actor_only', [False, True])
@pytest.mark.parametrize('early_stopping', [False, True])
@pytest.mark.parametrize(('optimizer', 'lr'), [('adam', 1e-3), ('sgd', 0.02)])
def test_steps_equal_the_eager_engine_s(name, settings, actor_only, early_stopping, optimizer, lr):
    base = tiny_agent(name, hidden=(40, 32), **settings)
    weights = weights_of(base)
    batches = batches_for(base, STEPS, size=32)
    shared = {'lr': lr, 'optimizer': optimizer, 'actor_only': actor_only}
    if early_stopping:
        (shared['test_batch'],) = batches_for(base, 1, size=20, seed=9)
    eager = run_inner_loop(base, batches, **shared)
    result = run_inner_loop(base, batches, engine='auto', **shared)
    assert_bit_equal(base, weights)
    assert largest_difference(result, eager) < 0.02 * lr * STEPS
    np.testing.assert_allclose(result.train_losses, eager.train_losses, rtol=1e-4)
    np.testing.assert_allclose(result.test_losses, eager.test_losses, rtol=1e-4)
    assert result.best_step == eager.best_step > 0
    assert all(weight.grad is None for weight in result.agent.parameters())


@LEARNERS
@pytest.mark.parametrize('actor_only', [False, True])
@pytest.mark.parametrize('engine', ['auto', 'eager'])
def test_products_in_bfloat16_follow_float32(name, settings, actor_only, engine):
    base = tiny_agent(name, hidden=(40, 32), **settings)
    batches = batches_for(base, STEPS, size=32)
    shared = {'lr': 1e-3, 'actor_only': actor_only, 'engine': engine}
    exact = run_inner_loop(base, batches, **shared)
    rounded = run_inner_loop(base, batches, precision='bfloat16', **shared)
    np.testing.assert_allclose(rounded.train_losses, exact.train_losses, rtol=0.05)
    assert rounded.train_losses != exact.train_losses
    assert all(weight.dtype == torch.float32 for weight in rounded.agent.parameters())


@pytest.mark.parametrize('early_stopping', [False, True])
@pytest.mark.parametrize('name', ['gcbc', 'gciql'])
def test_adapt_draws_the_same_batches_for_both(name, early_stopping):
    dataset, agent = random_dataset([30, 30]), tiny_agent(name)
    results = [
        adapt(
            agent,
            dataset,
            support_of(range(40)),
            GOAL,
            quick(engine=engine, early_stopping=early_stopping, lr=1e-3),
            seed=5,
        )
        for engine in ('auto', 'eager')
    ]
    assert results[0].best_step == results[1].best_step
    np.testing.assert_allclose(results[0].train_losses, results[1].train_losses, rtol=1e-4)
    np.testing.assert_allclose(results[0].test_losses, results[1].test_losses, rtol=1e-4)
    assert largest_difference(*results) < 1e-4


def engine_of(agent, name='auto'):
    parameters = list(agent.trained_parameters())
    return make_engine(name, agent, make_optimizer('adam', parameters, 0.1), parameters).name


def test_agents_without_a_loss_written_out_run_eagerly():
    class Other(GCBC):
        pass

    assert engine_of(tiny_agent()) == 'analytic'
    assert engine_of(tiny_agent(), 'eager') == 'eager'
    assert engine_of(tiny_agent(const_std=False)) == 'eager'
    other = tiny_agent()
    other.__class__ = Other
    assert engine_of(other) == 'eager'
