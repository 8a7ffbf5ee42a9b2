"""Subgoal advantage-weighted policy bootstrapping (Zhou and Kao 2025, arXiv 2505.14975).

Every default is that of the authors' code, github.com/johnlyzhou/saw: `impls/agents/saw.py` for
expectile 0.7, tau 0.005, waypoints 25 steps ahead, the inverse temperatures of 3, the cap of 100,
representations of width 10 and the goal distributions; `impls/hyperparameters.sh` for the mazes:
pointmaze and antmaze as the defaults (giant mazes: discount 0.995), humanoidmaze with discount
0.995 and waypoints 100 steps ahead.
"""

from collections.abc import Mapping
from typing import ClassVar, TYPE_CHECKING

import torch
from torch import Tensor

from metagcttt_core.agents.agent import Agent, log_std_of, TensorBatch
from metagcttt_core.agents.config import AgentSettings, SAWSettings
from metagcttt_core.agents.extraction import advantage_weight
from metagcttt_core.agents.networks import GoalRepresentation, MLP, RepresentedGoalPolicy
from metagcttt_core.agents.state_value import StateValue
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.relabel import GoalRelabeller

if TYPE_CHECKING:
    from metagcttt_core.agents.analytic import AnalyticLoss
    from metagcttt_core.kernels import Kernels


class SAW(Agent):
    """A flat actor that learns from advantages and from a sub-policy for near waypoints.

    The twin values V(s, phi([s; g])) share their representation phi, which has no target network;
    the actor has a representation of its own, the sub-policy none.
    """

    name: ClassVar[str] = 'saw'
    settings_type: ClassVar[type[AgentSettings]] = SAWSettings
    settings: SAWSettings
    plain_policy: ClassVar[str] = 'subpolicy'
    reference_networks: ClassVar[Mapping[str, tuple[str, ...]]] = {
        **Agent.reference_networks,
        'modules_low_actor': ('subpolicy',),
        'modules_value': ('value1', 'value2'),
        'modules_target_value': ('target1', 'target2'),
        'modules_goal_rep': ('value_rep',),
        'modules_actor_goal_rep_def': ('actor.goal_rep',),
    }

    def __init__(
        self, obs_dim: int, act_dim: int, settings: SAWSettings, generator: torch.Generator
    ) -> None:
        """Build actor, sub-policy, two values and their targets, which start as copies."""
        super().__init__(obs_dim, act_dim, settings, generator)
        self.subpolicy = super().make_actor(generator)
        self.value_rep = GoalRepresentation(
            2 * obs_dim, settings.hidden, settings.rep_dim, layer_norm=True, generator=generator
        )

        def network() -> MLP:
            width = obs_dim + settings.rep_dim
            return MLP(width, settings.hidden, 1, layer_norm=True, generator=generator)

        self.value1, self.value2 = network(), network()
        self.target1 = network().requires_grad_(False)
        self.target2 = network().requires_grad_(False)
        self.target1.load_state_dict(self.value1.state_dict())
        self.target2.load_state_dict(self.value2.state_dict())

    def make_actor(self, generator: torch.Generator) -> MLP:
        """A fresh policy network with a goal representation."""
        hidden, rep_dim = self.settings.hidden, self.settings.rep_dim
        return self.with_stds(
            RepresentedGoalPolicy(self.obs_dim, hidden, self.act_dim, rep_dim, generator)
        )

    def relabeller(self, dataset: TrajectoryDataset) -> GoalRelabeller:
        """The source of batches, with waypoints."""
        settings = self.settings
        return GoalRelabeller(
            dataset,
            settings.goals,
            settings.discount,
            subgoal_steps=settings.subgoal_steps,
            scaling=self.scaling,
        )

    def losses(
        self, batch: TensorBatch, *, actor_only: bool = False
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The sum of the value, sub-policy and actor losses, and its parts."""
        actor, parts = self._actor_loss(batch)
        if actor_only:
            return actor, parts
        value, subpolicy = self._value_loss(batch), self._subpolicy_loss(batch)
        parts |= {'value': value.detach(), 'subpolicy': subpolicy.detach()}
        return value + subpolicy + actor, parts

    def _value_loss(self, batch: TensorBatch) -> Tensor:
        """Expectile regression of each value towards r + discount mask V'(s', g) of its target.

        The sign of the targets' advantage, with the smaller of the two at s' and their mean at s,
        chooses the side of the expectile.
        """
        goals, discount = batch['value_goals'], self.settings.discount * batch['masks']
        inputs = self._value_inputs(batch['observations'], goals)
        with torch.no_grad():
            next_inputs = self._value_inputs(batch['next_observations'], goals)
            next_values = self._twins(self.target1, self.target2, next_inputs)
            returns = batch['rewards'] + discount * next_values
            mean = self._twins(self.target1, self.target2, inputs).mean(0)
            better = returns.amin(0) >= mean
            weight = torch.where(better, self.settings.expectile, 1 - self.settings.expectile)
        errors = returns - self._twins(self.value1, self.value2, inputs)
        return (weight * errors.square()).mean(-1).sum()

    def _subpolicy_loss(self, batch: TensorBatch) -> Tensor:
        """Advantage-weighted cloning towards states `subgoal_steps` ahead."""
        goals = batch['subgoals']
        log_prob, _ = self.log_prob_of(
            self.subpolicy, batch['observations'], goals, batch['actions']
        )
        value, next_value = self._values(goals, batch['observations'], batch['next_observations'])
        weight = advantage_weight(self.settings.subpolicy_alpha * (next_value - value))
        return -(weight * log_prob).mean()

    def _actor_loss(self, batch: TensorBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Advantage-weighted cloning, and the divergence from the sub-policy at the waypoint."""
        observations, goals = batch['observations'], batch['actor_goals']
        log_prob, mean = self.log_prob(observations, goals, batch['actions'])
        value, next_value, waypoint_value = self._values(
            goals, observations, batch['next_observations'], batch['waypoints']
        )
        advantage = next_value - value
        awr = -(advantage_weight(self.settings.alpha * advantage) * log_prob).mean()
        weight = advantage_weight(self.settings.waypoint_alpha * (waypoint_value - value))
        divergence = self._divergence(mean, observations, batch['waypoints'])
        waypoint = (weight * divergence).mean()
        loss = awr + waypoint
        parts = {'bc': -log_prob.mean(), 'advantage': advantage.mean()}
        parts |= {'awr': awr, 'waypoint': waypoint, 'actor': loss}
        return loss, {name: part.detach() for name, part in parts.items()}

    def _divergence(self, mean: Tensor, observations: Tensor, waypoints: Tensor) -> Tensor:
        """KL(sub-policy at the waypoint || actor), (B,); the sub-policy is a constant.

        With unit deviations twice that, the squared distance of the means, as the authors have it.
        """
        with torch.no_grad():
            target = self.subpolicy(_join(observations, waypoints))
        squared = (mean - target).square()
        if self.settings.const_std:
            return squared.sum(-1)
        own, other = log_std_of(self.actor), log_std_of(self.subpolicy).detach()
        spread = ((2 * other).exp() + squared) / (2 * (2 * own).exp())
        return (own - other + spread - 0.5).sum(-1)

    @torch.no_grad()
    def _values(self, goals: Tensor, *states: Tensor) -> tuple[Tensor, ...]:
        """V of each batch of states for the same goals, (B,) each."""
        repeated = goals.repeat(len(states), 1)
        return self.state_value(torch.cat(states), repeated).chunk(len(states))

    def state_value(self, observations: Tensor, goals: Tensor) -> Tensor:
        """V(s, g), the mean of both values, of observations and goals (B, obs_dim), (B,)."""
        inputs = self._value_inputs(observations, goals)
        return self._twins(self.value1, self.value2, inputs).mean(0)

    def _value_inputs(self, observations: Tensor, goals: Tensor) -> Tensor:
        return _join(observations, self.value_rep(_join(observations, goals)))

    @staticmethod
    def _twins(first: MLP, second: MLP, inputs: Tensor) -> Tensor:
        """The outputs of both networks, (2, B)."""
        return torch.stack([first(inputs), second(inputs)]).squeeze(-1)

    def analytic_loss(
        self,
        *,
        actor_only: bool = False,
        dtype: torch.dtype = torch.float32,
        kernels: 'Kernels | None' = None,
    ) -> 'AnalyticLoss | None':
        """See `Agent.analytic_loss`; on a processor, with unit standard deviations."""
        from metagcttt_core.agents.analytic_saw import AnalyticSAW

        if not self._has_analytic_loss_of(SAW):
            return None
        return AnalyticSAW(self, dtype, kernels, actor_only=actor_only)

    @torch.no_grad()
    def update_targets(self) -> None:
        """Move the target values by tau towards the values."""
        targets: list[Tensor] = [*self.target1.parameters(), *self.target2.parameters()]
        values: list[Tensor] = [*self.value1.parameters(), *self.value2.parameters()]
        torch._foreach_lerp_(targets, values, self.settings.tau)

    @property
    def value_fn(self) -> StateValue:
        """V(observations (n, obs_dim), goal (obs_dim,)) -> (n,) float32."""
        return StateValue.of(self, self.value_rep, self.value1, self.value2)


def _join(*parts: Tensor) -> Tensor:
    return torch.cat(parts, dim=-1)
