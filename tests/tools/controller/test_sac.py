"""Soft actor-critic against slow references, and on a problem it has to solve."""

from metagcttt_tools.controller.sac import SAC, SACConfig, StackedMLP
import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

SMALL = {'actor_hidden': (16, 16), 'critic_hidden': (16, 16)}


def batch(size: int, obs_dim: int = 3, act_dim: int = 2, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    return {
        'observations': draw(size, obs_dim),
        'actions': draw(size, act_dim).clamp(-1, 1),
        'next_observations': draw(size, obs_dim),
        'rewards': draw(size),
        'masks': (draw(size) > 0).float(),
    }


@pytest.mark.parametrize('layer_norm', [False, True])
def test_stacked_networks_equal_networks_one_by_one(layer_norm: bool) -> None:
    stack = StackedMLP(2, (3, 5, 4, 1), torch.Generator().manual_seed(0), layer_norm=layer_norm)
    inputs = batch(7)['observations']
    together = stack(inputs)
    assert together.shape == (2, 7, 1)
    for copy in range(2):
        x = inputs
        for index, (weight, bias) in enumerate(zip(stack.weights, stack.biases, strict=True)):
            x = x @ weight[copy] + bias[copy]
            if index < 2:
                x = torch.nn.functional.layer_norm(x, x.shape[-1:]) if layer_norm else x
                x = x.clamp(min=0)
        torch.testing.assert_close(together[copy], x)


def test_log_density_is_that_of_a_squashed_normal() -> None:
    learner = SAC(3, 2, SACConfig(**SMALL), seed=0)
    observations = batch(50)['observations']
    actions, log_probs = learner._sample(observations, learner.noise(50, np.random.default_rng(0)))
    mean, log_std = learner.actor(observations)[0].chunk(2, dim=-1)
    normal = Independent(Normal(mean, log_std.clamp(-5, 2).exp()), 1)
    reference = TransformedDistribution(normal, [TanhTransform()])
    torch.testing.assert_close(log_probs, reference.log_prob(actions), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize('critics', ['min', 'mean'])
def test_update_descends_the_textbook_losses(critics: str) -> None:
    config = SACConfig(**SMALL, critics=critics, temperature=0.3)
    learner, data = SAC(3, 2, config, seed=1), batch(32)
    rng = np.random.default_rng(4)
    next_noise, noise = learner.noise(32, rng), learner.noise(32, rng)
    combine = (lambda q: q.min(dim=0).values) if critics == 'min' else (lambda q: q.mean(dim=0))

    def q_values(critic: StackedMLP, observations: torch.Tensor, actions: torch.Tensor):
        return critic(torch.cat([observations, actions], dim=-1))[..., 0]

    with torch.no_grad():
        next_actions, next_log_probs = learner._sample(data['next_observations'], next_noise)
        next_values = combine(q_values(learner.target, data['next_observations'], next_actions))
        target = data['rewards'] + 0.99 * data['masks'] * (next_values - 0.3 * next_log_probs)
    errors = q_values(learner.critic, data['observations'], data['actions']) - target
    critic_gradients = torch.autograd.grad(
        errors.square().mean(), list(learner.critic.parameters())
    )
    actions, log_probs = learner._sample(data['observations'], noise)
    values = combine(q_values(learner.critic, data['observations'], actions))
    actor_gradients = torch.autograd.grad(
        (0.3 * log_probs - values).mean(), list(learner.actor.parameters())
    )
    entropy = -log_probs.mean().item()
    old_target = [p.clone() for p in learner.target.parameters()]

    learner.update(data, np.random.default_rng(4))
    for parameters, gradients in (
        (learner.critic.parameters(), critic_gradients),
        (learner.actor.parameters(), actor_gradients),
    ):
        for parameter, gradient in zip(parameters, gradients, strict=True):
            torch.testing.assert_close(parameter.grad, gradient, rtol=1e-4, atol=1e-6)
    assert learner.log_temperature.grad.item() == pytest.approx(entropy + 0.5 * 2, rel=1e-4)
    for target_weight, old, new in zip(
        learner.target.parameters(), old_target, learner.critic.parameters(), strict=True
    ):
        torch.testing.assert_close(target_weight, 0.995 * old + 0.005 * new)


def test_restored_learner_goes_on_with_the_same_bits() -> None:
    first, second = (SAC(3, 2, SACConfig(**SMALL), seed=seed) for seed in (0, 1))
    for step in range(3):
        first.update(batch(16, seed=step), np.random.default_rng(step))
    second.load_tensors({name: tensor.clone() for name, tensor in first.tensors().items()})
    for learner in (first, second):
        learner.update(batch(16, seed=9), np.random.default_rng(9))
    for name, tensor in first.tensors().items():
        assert torch.equal(tensor, second.tensors()[name]), name


def test_learns_which_action_is_rewarded() -> None:
    """One step: the reward is highest where the action equals the observation's first number."""
    config = SACConfig(**SMALL, lr=3e-3, target_entropy=-2.0)
    learner, rng = SAC(1, 1, config, seed=0), np.random.default_rng(0)
    for _ in range(600):
        observations = rng.uniform(-0.8, 0.8, (64, 1)).astype(np.float32)
        actions = rng.uniform(-1, 1, (64, 1)).astype(np.float32)
        learner.update(
            {
                'observations': torch.from_numpy(observations),
                'actions': torch.from_numpy(actions),
                'next_observations': torch.from_numpy(observations),
                'rewards': torch.from_numpy(-np.square(actions - observations)[:, 0]),
                'masks': torch.zeros(64),
            },
            rng,
        )
    wanted = np.linspace(-0.7, 0.7, 5)
    chosen = [np.mean([learner.act(np.array([x]), rng) for _ in range(50)]) for x in wanted]
    np.testing.assert_allclose(chosen, wanted, atol=0.2)


def test_update_of_the_critics_alone_leaves_actor_and_temperature() -> None:
    config = SACConfig(**SMALL, critic_lr=0.01)
    learner = SAC(3, 2, config, seed=0)
    learner.update(batch(16), np.random.default_rng(0))
    before = {name: tensor.clone() for name, tensor in learner.tensors().items()}
    learner.update(batch(16, seed=1), np.random.default_rng(1), actor=False)
    changed = {
        name.split('.')[0]
        for name, tensor in learner.tensors().items()
        if not torch.equal(tensor, before[name])
    }
    assert changed == {'critic', 'target', 'adam'}
    assert [group['lr'] for group in learner.optimizer.param_groups] == [3e-4, 0.01, 3e-4]
    learner.scale_lr(0.5)
    assert [group['lr'] for group in learner.optimizer.param_groups] == [1.5e-4, 0.005, 1.5e-4]


def test_actor_may_follow_the_first_critic_alone() -> None:
    config = SACConfig(**SMALL, actor_critics='first', actor_layer_norm=True)
    learner, data = SAC(3, 2, config, seed=0), batch(32)
    rng = np.random.default_rng(4)
    _, noise = learner.noise(32, rng), learner.noise(32, rng)
    actions, log_probs = learner._sample(data['observations'], noise)
    values = learner.critic(torch.cat([data['observations'], actions], dim=-1))[0, :, 0]
    expected = torch.autograd.grad(
        (0.02 * log_probs - values).mean(), list(learner.actor.parameters())
    )
    learner.update(data, np.random.default_rng(4))
    for parameter, gradient in zip(learner.actor.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-4, atol=1e-6)


def test_actions_of_many_are_those_one_by_one() -> None:
    learner = SAC(3, 2, SACConfig(**SMALL, log_std_range=(-20.0, -15.0)), seed=0)
    observations = batch(5)['observations'].numpy()
    together = learner.act_all(observations, np.random.default_rng(0))
    single = [learner.act(row, np.random.default_rng(0)) for row in observations]
    np.testing.assert_allclose(together, single, atol=1e-5)  # the noise is next to nothing
