"""Contrastive reinforcement learning (Eysenbach et al. 2022, arXiv 2206.07568), as OGBench has it.

Every default is that of OGBench's code, github.com/seohongpark/ogbench: `impls/agents/crl.py` for
the actor loss ddpgbc with alpha 0.1, discount 0.99, representations of width 512 with layer norm,
value goals geometrically later on the trajectory and actor goals uniformly;
`impls/hyperparameters.sh` for the mazes: alpha 0.1 for ant and humanoid, 0.03 for the point and
0.003 for antmaze explore data, discount 0.995 for humanoids and giant mazes, half of the actor
goals random for stitch data and all of them for explore data.
"""

from collections.abc import Mapping
import math
from typing import ClassVar

import torch
from torch import nn, Tensor
from torch.nn import functional

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.agents.config import AgentSettings, CRLSettings
from metagcttt_core.agents.extraction import extraction_loss, frozen
from metagcttt_core.agents.networks import MLP
from metagcttt_core.agents.state_value import StateValue


class Bilinear(nn.Module):
    """The score phi(x) . psi(g) / sqrt(width) of inputs x and goals g."""

    def __init__(
        self, in_dim: int, goal_dim: int, settings: CRLSettings, generator: torch.Generator
    ) -> None:
        """Build `phi` and `psi`."""
        super().__init__()
        self.phi, self.psi = (
            MLP(
                width,
                settings.hidden,
                settings.latent_dim,
                layer_norm=True,
                generator=generator,
            )
            for width in (in_dim, goal_dim)
        )

    def forward(self, inputs: Tensor, goals: Tensor) -> Tensor:
        """Map (B, in_dim) and (B, goal_dim) to scores (B,)."""
        phi, psi = self.phi(inputs), self.psi(goals)
        return (phi * psi).sum(-1) / math.sqrt(phi.shape[-1])

    def contrast(self, inputs: Tensor, goals: Tensor) -> Tensor:
        """Binary cross-entropy, over all pairs of a batch, of telling own goals from others'.

        At its minimum the score is log p(g | x) / p(g) less log(B - 1).
        """
        phi, psi = self.phi(inputs), self.psi(goals)
        logits = (phi @ psi.T / math.sqrt(phi.shape[-1])).to(phi.dtype)
        own = torch.eye(len(phi), dtype=logits.dtype, device=logits.device)
        return functional.binary_cross_entropy_with_logits(logits, own)


class CRL(Agent):
    """Twin contrastive critics Q((s, a), g), without bootstrapping, and an extracted actor.

    With `awr` there is a contrastive value V(s, g) as well, which the advantages need.
    """

    name: ClassVar[str] = 'crl'
    settings_type: ClassVar[type[AgentSettings]] = CRLSettings
    settings: CRLSettings
    reference_networks: ClassVar[Mapping[str, tuple[str, ...]]] = {
        **Agent.reference_networks,
        'modules_critic': ('critic1', 'critic2'),
        'modules_value': ('value',),
    }

    def __init__(
        self, obs_dim: int, act_dim: int, settings: CRLSettings, generator: torch.Generator
    ) -> None:
        """Build actor, critics and, for `awr`, the value."""
        super().__init__(obs_dim, act_dim, settings, generator)
        self.critic1 = Bilinear(obs_dim + act_dim, obs_dim, settings, generator)
        self.critic2 = Bilinear(obs_dim + act_dim, obs_dim, settings, generator)
        self.value: Bilinear | None = None
        if settings.actor_loss == 'awr':
            self.value = Bilinear(obs_dim, obs_dim, settings, generator)

    def losses(
        self, batch: TensorBatch, *, actor_only: bool = False
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The sum of the critics', value and actor losses, and its parts."""
        loss, parts = extraction_loss(self, self.settings, batch, self._frozen_q, self.state_value)
        if actor_only:
            return loss, parts
        goals = batch['value_goals']
        inputs = torch.cat([batch['observations'], batch['actions']], dim=-1)
        critic = (self.critic1.contrast(inputs, goals) + self.critic2.contrast(inputs, goals)) / 2
        parts['critic'] = critic.detach()
        loss = critic + loss
        if self.value is not None:
            value = self.value.contrast(batch['observations'], goals)
            parts['value'] = value.detach()
            loss = value + loss
        return loss, parts

    def _frozen_q(self, observations: Tensor, goals: Tensor, actions: Tensor) -> Tensor:
        """The smaller critic (B,), differentiable in its inputs but not in its weights."""
        inputs = torch.cat([observations, actions], dim=-1)
        return torch.minimum(
            frozen(self.critic1, inputs, goals), frozen(self.critic2, inputs, goals)
        )

    def state_value(self, observations: Tensor, goals: Tensor) -> Tensor:
        """V(s, g) of observations and goals (B, obs_dim), (B,), a log-ratio of densities.

        Without a value it is the smaller critic at the actor's action.
        """
        if self.value is not None:
            return self.value(observations, goals)
        actions = self.actor(torch.cat([observations, goals], dim=-1)).clamp(-1, 1)
        return self._frozen_q(observations, goals, actions)

    @property
    def value_fn(self) -> StateValue:
        """V(observations (n, obs_dim), goal (obs_dim,)) -> (n,) float32."""
        if self.value is not None:
            return StateValue.of(self, self.value)
        return StateValue.of(self, self.actor, self.critic1, self.critic2)
