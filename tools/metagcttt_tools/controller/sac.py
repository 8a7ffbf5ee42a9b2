"""Soft actor-critic (SAC), short and made for one CPU core.

Source: Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", arXiv:1812.05905; the
losses are taken together and stepped by one optimiser, as in OGBench's `main_sac.py`.
"""

from itertools import pairwise
import math
from typing import Any

import numpy as np
import torch
from torch import nn, Tensor
from torch.nn import functional

from metagcttt_tools.controller.config import SACConfig

_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class StackedMLP(nn.Module):
    """Multilayer perceptrons with ReLU, several of the same shape evaluated together."""

    def __init__(
        self,
        copies: int,
        widths: tuple[int, ...],
        generator: torch.Generator,
        *,
        layer_norm: bool = False,
    ) -> None:
        """Draw weights and biases uniformly within 1 / sqrt(fan in).

        Args:
            copies: Number of networks.
            widths: Units of the input, of each hidden layer and of the output.
            generator: Source of the weights.
            layer_norm: Normalise each hidden layer before its ReLU.
        """
        super().__init__()
        self.layer_norm = layer_norm
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in pairwise(widths):
            limit = 1 / math.sqrt(fan_in)
            for parameters, rows in ((self.weights, fan_in), (self.biases, 1)):
                values = torch.empty(copies, rows, fan_out)
                parameters.append(
                    nn.Parameter(values.uniform_(-limit, limit, generator=generator))
                )

    def forward(self, inputs: Tensor, copies: int | None = None) -> Tensor:
        """Map (batch, in) to (copies, batch, out), by all networks or by the first ones."""
        x = inputs.expand(copies or len(self.weights[0]), *inputs.shape)
        last = len(self.weights) - 1
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if copies is not None:
                weight, bias = weight[:copies], bias[:copies]
            x = torch.baddbmm(bias, x, weight)
            if index < last:
                x = functional.layer_norm(x, x.shape[-1:]) if self.layer_norm else x
                x = functional.relu(x, inplace=True)
        return x


class SAC:
    """Actor, twin critics with averaged targets, and a learned temperature.

    Batches are dictionaries of float32 tensors: `observations`, `actions`, `next_observations` of
    shape (batch, dim) and `rewards`, `masks` of shape (batch,); a mask is 0 where the episode
    ended by a fall, else 1.
    """

    def __init__(self, obs_dim: int, act_dim: int, config: SACConfig, seed: int) -> None:
        """Draw the networks."""
        generator = torch.Generator().manual_seed(seed)
        self.config = config
        self.act_dim = act_dim
        actor_widths = (obs_dim, *config.actor_hidden, 2 * act_dim)
        self.actor = StackedMLP(1, actor_widths, generator, layer_norm=config.actor_layer_norm)
        critic_widths = (obs_dim + act_dim, *config.critic_hidden, 1)
        self.critic, self.target = (
            StackedMLP(2, critic_widths, generator, layer_norm=config.critic_layer_norm)
            for _ in range(2)
        )
        self.target.load_state_dict(self.critic.state_dict())
        self.log_temperature = nn.Parameter(torch.tensor(math.log(config.temperature)))
        self._actor: list[Tensor] = list(self.actor.parameters())
        self._critic: list[Tensor] = list(self.critic.parameters())
        self._target: list[Tensor] = list(self.target.parameters())
        groups: list[dict[str, Any]] = [
            {'params': self._actor},
            {'params': self._critic, 'lr': config.critic_lr or config.lr},
            {'params': [self.log_temperature]},
        ]
        self.optimizer = torch.optim.Adam(groups, lr=config.lr, fused=True)
        self._full_lr: list[float] = [group['lr'] for group in self.optimizer.param_groups]

    def act(self, observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Sampled action of shape (act_dim,), float32, for an observation of shape (obs_dim,)."""
        return self.act_all(observation[None], rng)[0]

    @torch.no_grad()
    def act_all(self, observations: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Sampled actions of shape (n, act_dim) for observations of shape (n, obs_dim)."""
        inputs = torch.from_numpy(observations.astype(np.float32))
        return self._sample(inputs, self.noise(len(inputs), rng))[0].numpy()

    def noise(self, batch_size: int, rng: np.random.Generator) -> Tensor:
        """Standard normal draws for the actions of a batch, (batch, act_dim)."""
        return torch.from_numpy(rng.standard_normal((batch_size, self.act_dim), np.float32))

    def update(
        self, batch: dict[str, Tensor], rng: np.random.Generator, *, actor: bool = True
    ) -> dict[str, Tensor]:
        """Take one step on all losses; returns scalars to log, detached.

        Args:
            batch: Transitions.
            rng: Source of the actions that are drawn.
            actor: Step the actor and the temperature too, not just the critics.
        """
        critic_loss = self._critic_loss(batch, self.noise(len(batch['rewards']), rng))
        _set_gradients(self._critic, critic_loss)
        scalars = {'critic_loss': critic_loss.detach()}
        if actor:
            scalars |= self._actor_gradients(batch['observations'], rng)
        else:
            for parameter in (*self._actor, self.log_temperature):
                parameter.grad = None
        self.optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(self._target, self._critic, self.config.tau)
        return scalars

    def scale_lr(self, share: float) -> None:
        """Learn at this share of the learning rates of the settings."""
        for group, full in zip(self.optimizer.param_groups, self._full_lr, strict=True):
            group['lr'] = share * full

    def tensors(self) -> dict[str, Tensor]:
        """State of the training for a resumed run, by name."""
        networks = {'actor': self.actor, 'critic': self.critic, 'target': self.target}
        named = {
            f'{network}.{name}': tensor
            for network, module in networks.items()
            for name, tensor in module.state_dict().items()
        }
        moments = {
            f'adam.{number}.{name}': tensor
            for number, state in self.optimizer.state_dict()['state'].items()
            for name, tensor in state.items()
        }
        return {**named, 'log_temperature': self.log_temperature.detach(), **moments}

    def load_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Take over what `tensors` gave."""
        for network in ('actor', 'critic', 'target'):
            prefix = f'{network}.'
            getattr(self, network).load_state_dict(
                {
                    name.removeprefix(prefix): tensor
                    for name, tensor in tensors.items()
                    if name.startswith(prefix)
                }
            )
        self.log_temperature.data.copy_(tensors['log_temperature'])
        moments: dict[int, dict[str, Tensor]] = {}
        for key, tensor in tensors.items():
            if key.startswith('adam.'):
                _, number, name = key.split('.')
                moments.setdefault(int(number), {})[name] = tensor
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), 'state': moments})

    def _actor_gradients(
        self, observations: Tensor, rng: np.random.Generator
    ) -> dict[str, Tensor]:
        actions, log_probs = self._sample(observations, self.noise(len(observations), rng))
        values = self._value(
            self.critic, observations, actions, first=self.config.actor_critics == 'first'
        )
        temperature = self.log_temperature.detach().exp()
        _set_gradients(self._actor, (temperature * log_probs - values).mean())
        entropy = -log_probs.detach().mean()
        self.log_temperature.grad = entropy - self.config.target_entropy * self.act_dim
        return {'value': values.detach().mean(), 'entropy': entropy, 'temperature': temperature}

    def _critic_loss(self, batch: dict[str, Tensor], noise: Tensor) -> Tensor:
        with torch.no_grad():
            actions, log_probs = self._sample(batch['next_observations'], noise)
            values = self._value(self.target, batch['next_observations'], actions)
            values = values - self.log_temperature.exp() * log_probs
            targets = batch['rewards'] + self.config.discount * batch['masks'] * values
        inputs = torch.cat([batch['observations'], batch['actions']], dim=-1)
        return (self.critic(inputs).squeeze(-1) - targets).square().mean()

    def _value(
        self, critic: StackedMLP, observations: Tensor, actions: Tensor, first: bool = False
    ) -> Tensor:
        copies = 1 if first else None
        both = critic(torch.cat([observations, actions], dim=-1), copies).squeeze(-1)
        return both.amin(dim=0) if self.config.critics == 'min' else both.mean(dim=0)

    def _sample(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (batch, act_dim) within -1 to 1 and their log densities (batch,)."""
        mean, log_std = self.actor(observations)[0].chunk(2, dim=-1)
        log_std = log_std.clamp(*self.config.log_std_range)
        raw = mean + log_std.exp() * noise
        # log(1 - tanh(u)^2) in the form that neither under- nor overflows.
        squashing = 2 * (math.log(2) - raw - functional.softplus(-2 * raw))
        log_prob = -0.5 * noise.square() - log_std - _HALF_LOG_TWO_PI - squashing
        return raw.tanh(), log_prob.sum(dim=-1)


def _set_gradients(parameters: list[Tensor], loss: Tensor) -> None:
    """Gradients of a loss for some parameters: no pass through weights for nothing."""
    gradients = torch.autograd.grad(loss, parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
