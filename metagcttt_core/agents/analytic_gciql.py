"""The losses of GCIQL with gradients written out (paper, equations 3 and 4)."""

import torch
from torch import Tensor

from metagcttt_core.agents.agent import TensorBatch
from metagcttt_core.agents.analytic import AnalyticLoss, Cloning, cloning_loss, HALF_LOG_TWO_PI
from metagcttt_core.agents.gciql import GCIQL
from metagcttt_core.agents.passes import passes_of
from metagcttt_core.kernels import Kernels


class AnalyticGCIQL(AnalyticLoss):
    """`GCIQL.losses` of an agent whose actor has unit standard deviation."""

    def __init__(
        self,
        agent: GCIQL,
        dtype: torch.dtype,
        kernels: Kernels | None = None,
        *,
        actor_only: bool,
    ) -> None:
        """The loss of `agent`, with matrix products in `dtype`."""
        self._settings = agent.settings
        self._actor_only = actor_only
        self._cloning = Cloning(agent, dtype, kernels)
        self._value, *critics = (
            passes_of(network, dtype, kernels)
            for network in (
                *(agent.value, agent.critic1, agent.critic2, agent.target1, agent.target2),
            )
        )
        self._critics, self._targets = critics[:2], critics[2:]
        networks = [self._cloning.actor]
        if not actor_only:
            networks += [self._value, *self._critics]
        self.gradients = [gradient for network in networks for gradient in network.gradients]

    @torch.no_grad()
    def __call__(
        self, batch: TensorBatch, *, backward: bool = True
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """See `AnalyticLoss`."""
        loss, parts = self._actor_loss(batch, backward)
        if self._actor_only:
            return loss, parts
        states = torch.cat([batch['observations'], batch['value_goals']], dim=-1)
        inputs = torch.cat([states, batch['actions']], dim=-1)
        value = self._value_loss(states, inputs, backward)
        critic = self._critic_loss(inputs, batch, backward)
        return value + critic + loss, parts | {'value': value, 'critic': critic}

    def _value_loss(self, states: Tensor, inputs: Tensor, backward: bool) -> Tensor:
        error = torch.minimum(*(target.forward(inputs) for target in self._targets))
        error -= self._value.forward(states)
        expectile = self._settings.expectile
        weighted = torch.where(error >= 0, expectile, 1 - expectile).mul_(error)
        loss = (weighted * error).mean()
        if backward:
            self._value.backward(weighted.mul_(-2 / len(error)))
        return loss

    def _critic_loss(self, inputs: Tensor, batch: TensorBatch, backward: bool) -> Tensor:
        following = torch.cat([batch['next_observations'], batch['value_goals']], dim=-1)
        # The gradient of V is taken: its passes are free again.
        next_v = self._value.forward(following).squeeze(-1)
        target = batch['rewards'] + self._settings.discount * batch['masks'] * next_v
        losses = []
        for critic in self._critics:
            error = critic.forward(inputs) - target.unsqueeze(-1)
            losses.append(error.square().mean())
            if backward:
                critic.backward(error.mul_(2 / len(error)))
        return losses[0] + losses[1]

    def _actor_loss(self, batch: TensorBatch, backward: bool) -> tuple[Tensor, dict[str, Tensor]]:
        error, mean = self._cloning.error(batch)
        bc = cloning_loss(error)
        parts = {'bc': bc}
        kind, alpha, size = self._settings.actor_loss, self._settings.alpha, len(error)
        if kind == 'bc':
            loss = bc
            gradient = error / size
        else:
            states = torch.cat([batch['observations'], batch['actor_goals']], dim=-1)
        if kind == 'ddpgbc':
            q, slope = self._smaller_q(states, mean.clamp(-1, 1), backward)
            scale = q.abs().mean() + 1e-6
            parts['q'] = -q.mean() / scale
            loss = parts['q'] + alpha * bc
            gradient = error.mul_(alpha / size)
            gradient -= slope.mul_((mean.abs() <= 1) / (size * scale))
        elif kind == 'awr':
            advantage, _ = self._smaller_q(states, batch['actions'], False)
            advantage -= self._value.forward(states)
            weight = torch.exp(alpha * advantage).clamp_(max=100)
            parts['advantage'] = advantage.mean()
            log_prob = -0.5 * error.square().sum(-1) - error.shape[1] * HALF_LOG_TWO_PI
            loss = -(weight.squeeze(-1) * log_prob).mean()
            gradient = error.mul_(weight).div_(size)
        if backward:
            self._cloning.actor.backward(gradient)
        return loss, parts | {'actor': loss}

    def _smaller_q(self, states: Tensor, actions: Tensor, backward: bool) -> tuple[Tensor, Tensor]:
        """The smaller critic (B, 1), and its gradient with respect to the actions (B, act_dim)."""
        inputs = torch.cat([states, actions], dim=-1)
        q1, q2 = (critic.forward(inputs) for critic in self._critics)
        slope = torch.zeros_like(actions)
        if backward:
            first = torch.where(q1 == q2, 0.5, (q1 < q2).float())  # as `torch.minimum` divides it
            for critic, share in zip(self._critics, (first, 1 - first), strict=True):
                gradient = critic.backward(share, weights=False, inputs=True)
                slope += gradient[:, states.shape[1] :]
        return torch.minimum(q1, q2), slope
