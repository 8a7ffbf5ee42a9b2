"""The losses of GCIQL with gradients written out (paper, equations 3 and 4)."""

import numpy as np
import torch
from torch import Tensor

from metagcttt_core.agents.agent import TensorBatch
from metagcttt_core.agents.analytic import (
    AnalyticLoss,
    Arrays,
    evaluated,
    HALF_LOG_TWO_PI,
    join,
    outputs_of,
    take_back,
)
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
        self._actor, self._value, *critics = (
            passes_of(network, dtype, kernels)
            for network in (
                *(agent.actor, agent.value, agent.critic1, agent.critic2),
                *(agent.target1, agent.target2),
            )
        )
        self._critics, self._targets = critics[:2], critics[2:]
        networks = [self._actor]
        if not actor_only:
            networks += [self._value, *self._critics]
        self.gradients = [gradient for network in networks for gradient in network.gradients]

    @torch.no_grad()
    def __call__(
        self, batch: TensorBatch, *, backward: bool = True
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """See `AnalyticLoss`."""
        arrays = {key: values.numpy() for key, values in batch.items()}
        loss, parts = self._actor_loss(arrays, backward)
        if not self._actor_only:
            states = join(arrays['observations'], arrays['value_goals'])
            inputs = join(states, arrays['actions'])
            parts['value'] = self._value_loss(states, inputs, backward)
            parts['critic'] = self._critic_loss(inputs, arrays, backward)
            loss = loss + parts['value'] + parts['critic']
        return torch.as_tensor(loss), {name: torch.as_tensor(part) for name, part in parts.items()}

    def _value_loss(self, states: np.ndarray, inputs: np.ndarray, backward: bool) -> np.float32:
        error = np.minimum(*(evaluated(target, inputs) for target in self._targets))
        error -= outputs_of(self._value, states)
        expectile = self._settings.expectile
        weighted = error * np.where(error >= 0, np.float32(expectile), np.float32(1 - expectile))
        if backward:
            take_back(self._value, weighted * np.float32(-2 / len(error)))
        return (weighted * error).mean()

    def _critic_loss(self, inputs: np.ndarray, batch: Arrays, backward: bool) -> np.float32:
        following = join(batch['next_observations'], batch['value_goals'])
        next_v = evaluated(self._value, following)[:, 0]
        target = batch['rewards'] + np.float32(self._settings.discount) * batch['masks'] * next_v
        loss = np.float32(0)
        for critic in self._critics:
            error = outputs_of(critic, inputs) - target[:, None]
            loss += np.square(error).mean()
            if backward:
                take_back(critic, error * np.float32(2 / len(error)))
        return loss

    def _actor_loss(
        self, batch: Arrays, backward: bool
    ) -> tuple[np.float32, dict[str, np.float32]]:
        states, actions = join(batch['observations'], batch['actor_goals']), batch['actions']
        mean = outputs_of(self._actor, states)
        error = mean - actions
        constant = np.float32(error.shape[1] * HALF_LOG_TWO_PI)
        nll = np.square(error).sum(-1, keepdims=True) * np.float32(0.5) + constant
        parts = {'bc': nll.mean()}
        kind, alpha, size = self._settings.actor_loss, np.float32(self._settings.alpha), len(error)
        if kind == 'bc':
            loss = parts['bc']
        elif kind == 'ddpgbc':
            q, slope = self._smaller_q(states, mean.clip(-1, 1), backward)
            scale = np.abs(q).mean() + np.float32(1e-6)
            parts['q'] = -q.mean() / scale
            loss = parts['q'] + alpha * parts['bc']
            error *= alpha
            error -= slope * ((np.abs(mean) <= 1) / scale)
        else:
            advantage = self._smaller_q(states, actions, False)[0]
            advantage -= evaluated(self._value, states)
            with np.errstate(over='ignore'):
                weight = np.minimum(np.exp(alpha * advantage), np.float32(100))
            parts['advantage'] = advantage.mean()
            loss = (weight * nll).mean()
            error *= weight
        if backward:
            take_back(self._actor, error / np.float32(size))
        return loss, parts | {'actor': loss}

    def _smaller_q(
        self, states: np.ndarray, actions: np.ndarray, backward: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """The smaller critic (B, 1), and its gradient with respect to the actions (B, act_dim)."""
        inputs = join(states, actions)
        outputs = outputs_of if backward else evaluated
        q1, q2 = (outputs(critic, inputs) for critic in self._critics)
        slope = np.zeros_like(actions)
        if backward:
            # As `torch.minimum` divides it where both are equal.
            first = np.float32(0.5) * ((q1 <= q2).astype(np.float32) + (q1 < q2))
            for critic, share in zip(self._critics, (first, 1 - first), strict=True):
                gradient = take_back(critic, share, weights=False, inputs=True)
                slope += gradient[:, states.shape[1] :]
        return np.minimum(q1, q2), slope
