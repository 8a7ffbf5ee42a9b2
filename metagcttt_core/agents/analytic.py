"""Losses with gradients written out, which the inner loop takes where an agent has them."""

from abc import ABC, abstractmethod
import math

import torch
from torch import Tensor

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.agents.passes import passes_of
from metagcttt_core.kernels import Kernels

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class AnalyticLoss(ABC):
    """An agent's loss and its gradient without autograd: `Agent.losses`, to rounding.

    Attributes:
        gradients: Those of the last call, one for each trained parameter; kept in the same memory.
    """

    gradients: list[Tensor]

    @abstractmethod
    def __call__(
        self, batch: TensorBatch, *, backward: bool = True
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a batch and its named parts; sets `gradients` unless told otherwise."""


class Cloning(AnalyticLoss):
    """Negative log-likelihood of the actions with unit standard deviation, of GCBC."""

    def __init__(self, agent: Agent, dtype: torch.dtype, kernels: Kernels | None = None) -> None:
        """The loss of `agent`, with matrix products in `dtype`."""
        self._actor = passes_of(agent.actor, dtype, kernels)
        self.gradients = self._actor.gradients

    @torch.no_grad()
    def __call__(
        self, batch: TensorBatch, *, backward: bool = True
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """See `AnalyticLoss`."""
        states = torch.cat([batch['observations'], batch['actor_goals']], dim=-1)
        error = self._actor.forward(states).sub_(batch['actions'])
        mse = error.square().mean()
        loss = mse * (0.5 * error.shape[1]) + error.shape[1] * HALF_LOG_TWO_PI
        if backward:
            self._actor.backward(error.div_(len(error)))
        return loss, {'bc': loss, 'mse': mse}
