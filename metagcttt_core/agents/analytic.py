"""Losses with gradients written out, which the inner loop takes where an agent has them.

Between the passes of the networks of an agent with values there are some seventy operations on a
number or two per transition: in NumPy, which takes a microsecond for what costs PyTorch five.
"""

from abc import ABC, abstractmethod
import math

import numpy as np
import torch
from torch import Tensor

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.agents.passes import Passes, passes_of
from metagcttt_core.kernels import Kernels

Arrays = dict[str, np.ndarray]
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
        outputs = self._actor.forward if backward else self._actor.evaluate
        error = outputs(states).sub_(batch['actions'])
        mse = error.square().mean()
        loss = mse * (0.5 * error.shape[1]) + error.shape[1] * HALF_LOG_TWO_PI
        if backward:
            self._actor.backward(error.div_(len(error)))
        return loss, {'bc': loss, 'mse': mse}


def join(*parts: np.ndarray) -> np.ndarray:
    """Arrays (B, n) side by side."""
    return np.concatenate(parts, axis=-1)


def evaluated(network: Passes, inputs: np.ndarray) -> np.ndarray:
    """The outputs of a network, (B, out_dim); see `Passes.evaluate`."""
    return network.evaluate(torch.from_numpy(inputs)).numpy()


def outputs_of(network: Passes, inputs: np.ndarray) -> np.ndarray:
    """The same, to go back from; see `Passes.forward`."""
    return network.forward(torch.from_numpy(inputs)).numpy()


def take_back(
    network: Passes, gradient: np.ndarray, *, weights: bool = True, inputs: bool = False
) -> np.ndarray:
    """The gradient with respect to the inputs, if asked for; see `Passes.backward`."""
    return network.backward(torch.from_numpy(gradient), weights=weights, inputs=inputs).numpy()
