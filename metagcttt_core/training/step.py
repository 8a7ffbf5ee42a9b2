"""One gradient step, the same in pre-training and in the inner loop."""

from collections.abc import Sequence

import torch
from torch import nn, Tensor

from metagcttt_core.agents.agent import Agent, TensorBatch


def gradient_step(
    agent: Agent,
    optimizer: torch.optim.Optimizer,
    parameters: Sequence[nn.Parameter],
    batch: TensorBatch,
    *,
    actor_only: bool = False,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Step `parameters` down the gradient of the batch's loss.

    All losses are taken before the step, and target networks move towards the networks as they
    were before it, as in the reference implementation.

    Returns:
        The loss before the step (detached) and its named parts.
    """
    loss, parts = agent.losses(batch, actor_only=actor_only)
    gradients = torch.autograd.grad(loss, parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    if not actor_only:
        agent.update_targets()
    optimizer.step()
    return loss.detach(), parts
