"""One gradient step, the same in pre-training and in the inner loop."""

from collections.abc import Sequence
from functools import partial

import torch
from torch import nn, Tensor

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.training.numerics import LossFunction


def gradient_step(
    agent: Agent,
    optimizer: torch.optim.Optimizer,
    parameters: Sequence[nn.Parameter],
    batch: TensorBatch,
    *,
    actor_only: bool = False,
    losses: LossFunction | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Step `parameters` down the gradient of the batch's loss.

    All losses are taken before the step, and target networks move towards the networks as they
    were before it, as in the reference implementation.

    Args:
        agent: What to train.
        optimizer: Steps `parameters`.
        parameters: Those that get a gradient.
        batch: Tensors by OGBench's keys.
        actor_only: Leave out the terms that do not train the actor, and the targets.
        losses: Another way to compute the loss, from `loss_function`; by default `agent.losses`.

    Returns:
        The loss before the step (detached) and its named parts.
    """
    if losses is None:
        losses = partial(agent.losses, actor_only=actor_only)
    loss, parts = losses(batch)
    gradients = torch.autograd.grad(loss, parameters)
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    if not actor_only:
        agent.update_targets()
    optimizer.step()
    return loss.detach(), parts
