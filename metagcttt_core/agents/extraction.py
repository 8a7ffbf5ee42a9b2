"""The loss of an actor that is extracted from a critic, and a critic whose weights stay."""

from collections.abc import Callable

import torch
from torch import nn, Tensor
from torch.func import functional_call

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.agents.config import ExtractionOptions

LARGEST_WEIGHT = 100.0


def extraction_loss(
    agent: Agent,
    options: ExtractionOptions,
    batch: TensorBatch,
    critic: Callable[[Tensor, Tensor, Tensor], Tensor],
    value: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, dict[str, Tensor]]:
    """The actor loss of a batch by `options.actor_loss`, and its parts, as OGBench has them.

    Args:
        agent: Whose actor to train.
        options: The kind of loss and `alpha`.
        batch: Tensors by OGBench's keys.
        critic: Q of observations, goals (B, obs_dim) and actions (B, act_dim), (B,);
            differentiable in the actions alone.
        value: V of observations and goals, (B,), for `awr`.
    """
    observations, goals = batch['observations'], batch['actor_goals']
    log_prob, mean = agent.log_prob(observations, goals, batch['actions'])
    bc = -log_prob.mean()
    parts = {'bc': bc.detach()}
    if options.actor_loss == 'bc':
        loss = bc
    elif options.actor_loss == 'ddpgbc':
        q = critic(observations, goals, mean.clamp(-1, 1))
        q_term = -q.mean() / (q.abs().mean().detach() + 1e-6)
        parts['q'] = q_term.detach()
        loss = q_term + options.alpha * bc
    else:
        with torch.no_grad():
            advantage = critic(observations, goals, batch['actions']) - value(observations, goals)
            weight = advantage_weight(options.alpha * advantage)
        parts['advantage'] = advantage.mean()
        loss = -(weight * log_prob).mean()
    return loss, parts | {'actor': loss.detach()}


def advantage_weight(exponent: Tensor) -> Tensor:
    """The weight of a transition in advantage-weighted cloning, capped."""
    return exponent.exp().clamp(max=LARGEST_WEIGHT)


def frozen(network: nn.Module, *inputs: Tensor) -> Tensor:
    """The output of a network, differentiable in its inputs but not in its weights."""
    weights = {name: weight.detach() for name, weight in network.named_parameters()}
    return functional_call(network, weights, inputs)
