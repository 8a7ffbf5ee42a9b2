"""The inner loop: a pure function of weights, optimiser state and batches."""

import math

from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_core.adaptation.inner_loop import run_inner_loop
from metagcttt_core.agents import GCBC
import numpy as np
import pytest
from tests.core.builders import assert_bit_equal, EVERY_AGENT, tiny_agent, weights_of
import torch


def batches_for(agent, count: int, size: int = 16, seed: int = 0):
    """Batches with all of OGBench's keys."""
    rng, states = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    masks = rng.integers(0, 2, size=(count, size)).astype(np.float32)
    return [
        agent.tensors(
            {
                'observations': rng.normal(size=(size, 2)).astype(np.float32),
                'next_observations': rng.normal(size=(size, 2)).astype(np.float32),
                'value_goals': rng.normal(size=(size, 2)).astype(np.float32),
                'actor_goals': rng.normal(size=(size, 2)).astype(np.float32),
                'actions': rng.uniform(-1, 1, size=(size, 2)).astype(np.float32),
                'rewards': masks[number] * -1,
                'masks': masks[number],
                'subgoals': states.normal(size=(size, 2)).astype(np.float32),
                'waypoints': states.normal(size=(size, 2)).astype(np.float32),
            }
        )
        for number in range(count)
    ]


def reference_loop(base, batches, optimizer_type, lr, *, actor_only=False):
    """The same steps with a plain torch loop; returns the agent and its losses."""
    agent = base.clone()
    parameters = [
        weight
        for name, weight in agent.named_parameters()
        if weight.requires_grad and (not actor_only or name.startswith('actor.'))
    ]
    optimizer = optimizer_type(parameters, lr=lr)
    losses = []
    for batch in batches:
        optimizer.zero_grad()
        loss = agent.losses(batch, actor_only=actor_only)[0]
        loss.backward()
        if not actor_only:
            agent.update_targets()
        optimizer.step()
        losses.append(loss.item())
    return agent, losses


def assert_close(agent, expected) -> None:
    for name, weight in agent.state_dict().items():
        torch.testing.assert_close(weight, expected.state_dict()[name], rtol=1e-5, atol=1e-7)


@EVERY_AGENT
@pytest.mark.parametrize('actor_only', [False, True])
@pytest.mark.parametrize(
    ('optimizer', 'reference', 'lr'),
    [('adam', torch.optim.Adam, 1e-2), ('sgd', torch.optim.SGD, 0.1)],
)
def test_steps_equal_a_torch_reference(name, actor_only, optimizer, reference, lr):
    base = tiny_agent(name)
    batches = batches_for(base, 6)
    result = run_inner_loop(base, batches, lr=lr, optimizer=optimizer, actor_only=actor_only)
    expected, losses = reference_loop(base, batches, reference, lr, actor_only=actor_only)
    assert_close(result.agent, expected)
    np.testing.assert_allclose(result.train_losses, losses, rtol=1e-5)
    assert (result.best_step, result.test_losses) == (6, [])


def test_first_adam_step_by_hand():
    """Without bias towards zero, the first step is lr g / (|g| + eps)."""
    base = tiny_agent()
    (batch,) = batches_for(base, 1)
    gradients = torch.autograd.grad(base.losses(batch)[0], list(base.parameters()))
    result = run_inner_loop(base, [batch], lr=0.01)
    for before, gradient, after in zip(
        base.parameters(), gradients, result.agent.parameters(), strict=True
    ):
        expected = before - 0.01 * gradient / (gradient.abs() + 1e-8)
        torch.testing.assert_close(after, expected, rtol=0, atol=1e-6)


@EVERY_AGENT
def test_base_stays_bit_equal_and_unlinked(name):
    base = tiny_agent(name)
    weights = weights_of(base)
    result = run_inner_loop(base, batches_for(base, 3), lr=0.1)
    assert_bit_equal(base, weights)
    assert all(weight.grad is None for weight in base.parameters())
    assert all(weight.grad is None for weight in result.agent.parameters())
    own = {weight.data_ptr() for weight in base.parameters()}
    assert not own & {weight.data_ptr() for weight in result.agent.parameters()}


def test_no_batches_give_the_base_weights():
    base = tiny_agent()
    result = run_inner_loop(base, [], lr=0.1)
    assert_bit_equal(result.agent, weights_of(base))
    assert (result.train_losses, result.best_step) == ([], 0)


@EVERY_AGENT
def test_early_stopping_keeps_the_weights_of_the_smallest_test_loss(name):
    base = tiny_agent(name)
    lr = {'crl': 0.3, 'saw': 0.05}.get(name, 0.6)  # at which the test loss rises in the end
    batches, (test_batch,) = batches_for(base, 12), batches_for(base, 1, seed=9)
    result = run_inner_loop(base, batches, lr=lr, test_batch=test_batch)
    # The loss of every intermediate agent, by running each number of steps on its own.
    agents = [run_inner_loop(base, batches[:steps], lr=lr).agent for steps in range(13)]
    losses = [agent.losses(test_batch)[0].item() for agent in agents]
    assert result.test_losses == losses
    assert len(result.train_losses) == 12
    assert result.best_step == int(np.argmin(losses))
    assert 0 < result.best_step < 12
    assert_bit_equal(result.agent, weights_of(agents[result.best_step]))
    assert result.agent.losses(test_batch)[0].item() == min(losses)


class Scripted(GCBC):
    """Reports prepared losses whenever it is tested (that is, without gradients)."""

    script: list[float]

    def losses(self, batch, *, actor_only=False):
        loss, parts = super().losses(batch, actor_only=actor_only)
        if not torch.is_grad_enabled():
            loss = torch.tensor(self.script.pop(0))
        return loss, parts


@pytest.mark.parametrize(
    ('script', 'best_step'),
    [
        ([3.0, 1.0, 2.0, 1.0], 1),
        ([1.0, 1.0, 1.0, 1.0], 0),
        ([1.0, 2.0, 3.0, 4.0], 0),
        ([4.0, 3.0, 2.0, 1.0], 3),
        ([3.0, math.nan, 2.0, -math.inf], 2),
        ([3.0, math.nan, math.inf, 2.5], 3),
        ([math.nan, 2.0, 1.0, 1.5], 2),
        ([math.nan, math.inf, math.nan, -math.inf], 0),
    ],
)
def test_earliest_step_wins_ties_and_nan_never_wins(script, best_step):
    base = tiny_agent()
    batches, (test_batch,) = batches_for(base, 3), batches_for(base, 1, seed=9)
    expected = run_inner_loop(base, batches[:best_step], lr=0.1).agent
    scripted = base.clone()
    scripted.__class__ = Scripted
    scripted.script = list(script)
    result = run_inner_loop(scripted, batches, lr=0.1, test_batch=test_batch)
    assert result.best_step == best_step
    assert result.test_losses == pytest.approx(script, nan_ok=True)
    assert_bit_equal(result.agent, weights_of(expected))


def test_pretrained_moments_are_used_and_left_as_they_are():
    base = tiny_agent()
    warm, batches = batches_for(base, 4, seed=1), batches_for(base, 3, seed=2)
    # A run of 4 + 3 steps, cut after 4, goes on as if it had not been cut.
    optimizer = torch.optim.Adam(base.parameters(), lr=0.05)
    for batch in warm:
        optimizer.zero_grad()
        base.losses(batch)[0].backward()
        optimizer.step()
    state = optimizer.state_dict()['state']
    copies = {
        number: {key: t.clone() for key, t in moments.items()} for number, moments in state.items()
    }
    weights = weights_of(base)
    result = run_inner_loop(base, batches, lr=0.05, optimizer_state=state)
    again = run_inner_loop(base, batches, lr=0.05, optimizer_state=state)
    fresh = run_inner_loop(base, batches, lr=0.05)
    assert_bit_equal(again.agent, weights_of(result.agent))
    assert all(
        torch.equal(state[number][key], tensor)
        for number, moments in copies.items()
        for key, tensor in moments.items()
    )
    assert_bit_equal(base, weights)
    for batch in batches:
        optimizer.zero_grad()
        base.losses(batch)[0].backward()
        optimizer.step()
    assert_close(result.agent, base)
    assert not torch.equal(fresh.agent.actor.mean.bias, result.agent.actor.mean.bias)


@pytest.mark.parametrize('stop_at', [1, 2, 5])
def test_cancelling_takes_no_further_step(stop_at):
    base = tiny_agent()
    weights = weights_of(base)
    asked, taken = [], []

    def should_stop():
        asked.append(1)
        return len(asked) == stop_at

    def batches():
        for batch in batches_for(base, 8):
            taken.append(1)
            yield batch

    with pytest.raises(AdaptationCancelled, match=f'cancelled before inner step {stop_at}$'):
        run_inner_loop(base, batches(), lr=0.1, should_stop=should_stop)
    assert len(asked) == len(taken) == stop_at
    assert_bit_equal(base, weights)


def test_not_cancelling_changes_nothing():
    base = tiny_agent()
    batches = batches_for(base, 4)
    asked = []
    result = run_inner_loop(base, batches, lr=0.1, should_stop=lambda: bool(asked.append(1)))
    assert len(asked) == 4
    assert_bit_equal(result.agent, weights_of(run_inner_loop(base, batches, lr=0.1).agent))


@pytest.mark.parametrize('actor_only', [False, True])
def test_every_step_is_told_with_its_losses_by_part(actor_only):
    base = tiny_agent('gciql')
    batches = batches_for(base, 4)
    told = []
    result = run_inner_loop(
        base,
        batches,
        lr=0.1,
        actor_only=actor_only,
        on_step=lambda step, losses: told.append((step, dict(losses))),
    )
    assert [step for step, _ in told] == [1, 2, 3, 4]
    assert [losses['total'].item() for _, losses in told] == result.train_losses
    first = {
        name: value.item()
        for name, value in base.losses(batches[0], actor_only=actor_only)[1].items()
    }
    assert {name: told[0][1][name].item() for name in first} == first
    assert not any(value.requires_grad for _, losses in told for value in losses.values())
    untold = run_inner_loop(base, batches, lr=0.1, actor_only=actor_only)
    assert_bit_equal(result.agent, weights_of(untold.agent))


def test_no_step_is_told_after_cancelling():
    base = tiny_agent()
    told = []
    with pytest.raises(AdaptationCancelled):
        run_inner_loop(
            base,
            batches_for(base, 8),
            lr=0.1,
            should_stop=lambda: len(told) == 3,
            on_step=lambda step, losses: told.append(step),
        )
    assert told == [1, 2, 3]
