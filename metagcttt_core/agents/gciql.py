"""Goal-conditioned implicit Q-learning (paper, section 3.1, equations 3 and 4)."""

from collections.abc import Mapping
from typing import ClassVar, TYPE_CHECKING

import torch
from torch import Tensor

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.agents.config import AgentSettings, GCIQLSettings
from metagcttt_core.agents.extraction import extraction_loss, frozen
from metagcttt_core.agents.networks import MLP
from metagcttt_core.agents.state_value import StateValue

if TYPE_CHECKING:
    from metagcttt_core.agents.analytic import AnalyticLoss
    from metagcttt_core.kernels import Kernels


class GCIQL(Agent):
    """Expectile value V(s, g), twin critics Q(s, g, a) with targets, and an extracted actor."""

    name: ClassVar[str] = 'gciql'
    settings_type: ClassVar[type[AgentSettings]] = GCIQLSettings
    settings: GCIQLSettings
    reference_networks: ClassVar[Mapping[str, tuple[str, ...]]] = {
        **Agent.reference_networks,
        'modules_value': ('value',),
        'modules_critic': ('critic1', 'critic2'),
        'modules_target_critic': ('target1', 'target2'),
    }

    def __init__(
        self, obs_dim: int, act_dim: int, settings: GCIQLSettings, generator: torch.Generator
    ) -> None:
        """Build actor, value, two critics and their targets, which start as copies."""
        super().__init__(obs_dim, act_dim, settings, generator)

        def network(in_dim: int) -> MLP:
            return MLP(in_dim, settings.hidden, 1, layer_norm=True, generator=generator)

        self.value = network(2 * obs_dim)
        self.critic1 = network(2 * obs_dim + act_dim)
        self.critic2 = network(2 * obs_dim + act_dim)
        self.target1 = network(2 * obs_dim + act_dim).requires_grad_(False)
        self.target2 = network(2 * obs_dim + act_dim).requires_grad_(False)
        self.target1.load_state_dict(self.critic1.state_dict())
        self.target2.load_state_dict(self.critic2.state_dict())

    def losses(
        self, batch: TensorBatch, *, actor_only: bool = False
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The sum of the value, critic and actor losses, and its parts."""
        actor, parts = self._actor_loss(batch)
        if actor_only:
            return actor, parts
        value, critic = self._value_loss(batch), self._critic_loss(batch)
        parts |= {'value': value.detach(), 'critic': critic.detach()}
        return value + critic + actor, parts

    def _value_loss(self, batch: TensorBatch) -> Tensor:
        """Expectile regression of V towards the smaller target critic."""
        inputs = _join(batch['observations'], batch['value_goals'], batch['actions'])
        with torch.no_grad():
            q = torch.minimum(self.target1(inputs), self.target2(inputs))
        error = q - self.value(_join(batch['observations'], batch['value_goals']))
        expectile = self.settings.expectile
        weight = torch.where(error >= 0, expectile, 1 - expectile)
        return (weight * error.square()).mean()

    def _critic_loss(self, batch: TensorBatch) -> Tensor:
        """Regression of both critics towards r + discount mask V(s', g)."""
        with torch.no_grad():
            next_v = self.value(_join(batch['next_observations'], batch['value_goals']))
            discount = self.settings.discount * batch['masks']
            target = batch['rewards'] + discount * next_v.squeeze(-1)
        inputs = _join(batch['observations'], batch['value_goals'], batch['actions'])
        errors = [critic(inputs).squeeze(-1) - target for critic in (self.critic1, self.critic2)]
        return sum(error.square().mean() for error in errors)

    def _actor_loss(self, batch: TensorBatch) -> tuple[Tensor, dict[str, Tensor]]:
        return extraction_loss(self, self.settings, batch, self._frozen_q, self.state_value)

    def _frozen_q(self, observations: Tensor, goals: Tensor, actions: Tensor) -> Tensor:
        """The smaller critic (B,), differentiable in its inputs but not in its weights."""
        inputs = _join(observations, goals, actions)
        qs = [frozen(critic, inputs) for critic in (self.critic1, self.critic2)]
        return torch.minimum(*qs).squeeze(-1)

    def analytic_loss(
        self,
        *,
        actor_only: bool = False,
        dtype: torch.dtype = torch.float32,
        kernels: 'Kernels | None' = None,
    ) -> 'AnalyticLoss | None':
        """See `Agent.analytic_loss`; on a processor, with unit standard deviation."""
        from metagcttt_core.agents.analytic_gciql import AnalyticGCIQL

        if not self._has_analytic_loss_of(GCIQL):
            return None
        return AnalyticGCIQL(self, dtype, kernels, actor_only=actor_only)

    @torch.no_grad()
    def update_targets(self) -> None:
        """Move the target critics by tau towards the critics."""
        targets: list[Tensor] = [*self.target1.parameters(), *self.target2.parameters()]
        critics: list[Tensor] = [*self.critic1.parameters(), *self.critic2.parameters()]
        torch._foreach_lerp_(targets, critics, self.settings.tau)

    def state_value(self, observations: Tensor, goals: Tensor) -> Tensor:
        """V(s, g) of observations and goals (B, obs_dim), (B,)."""
        return self.value(_join(observations, goals)).squeeze(-1)

    @property
    def value_fn(self) -> StateValue:
        """V(observations (n, obs_dim), goal (obs_dim,)) -> (n,) float32."""
        return StateValue.of(self, self.value)


def _join(*parts: Tensor) -> Tensor:
    return torch.cat(parts, dim=-1)
