"""The meta-updates: from adapted experts back to the base policy (paper, section 4).

Each takes the base agent, changed in place, and one `Expert` per task of the meta-batch. Adding
one is a function and a line in `META_UPDATES`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from metagcttt_core.adaptation.inner_loop import InnerLoopResult
from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.meta.config import MetaConfig


@dataclass(frozen=True)
class Expert:
    """The outcome of one task's inner loop and the test batch that scores it."""

    result: InnerLoopResult
    test_batch: TensorBatch


MetaUpdate = Callable[[Agent, Sequence[Expert], MetaConfig, torch.optim.Optimizer | None], None]


@torch.no_grad()
def continual(
    base: Agent,
    experts: Sequence[Expert],
    config: MetaConfig,
    optimizer: torch.optim.Optimizer | None = None,
) -> None:
    """CONTINUAL-TTT: theta <- mean of the adapted weights."""
    for name, weight in base.state_dict().items():
        weight.copy_(_mean_weight(experts, name))


@torch.no_grad()
def reptile(
    base: Agent,
    experts: Sequence[Expert],
    config: MetaConfig,
    optimizer: torch.optim.Optimizer | None = None,
) -> None:
    """TT-REPTILE: theta <- theta + beta (mean of the adapted weights - theta)."""
    for name, weight in base.state_dict().items():
        weight.add_(config.meta_lr * (_mean_weight(experts, name) - weight))


def fomaml(
    base: Agent,
    experts: Sequence[Expert],
    config: MetaConfig,
    optimizer: torch.optim.Optimizer | None = None,
) -> None:
    """TT-FOMAML: step theta with the mean test-loss gradient taken at the adapted weights."""
    if optimizer is None:
        raise ValueError('fomaml needs an outer optimizer')
    parameters = list(base.trained_parameters(actor_only=config.actor_only))
    means = [torch.zeros_like(parameter) for parameter in parameters]
    for expert in experts:
        adapted = list(expert.result.agent.trained_parameters(actor_only=config.actor_only))
        loss, _ = expert.result.agent.losses(expert.test_batch, actor_only=config.actor_only)
        gradients = torch.autograd.grad(loss, adapted)
        for mean, gradient in zip(means, gradients, strict=True):
            mean += gradient / len(experts)
    for parameter, mean in zip(parameters, means, strict=True):
        parameter.grad = mean
    optimizer.step()


META_UPDATES: dict[str, MetaUpdate] = {
    'continual': continual,
    'fomaml': fomaml,
    'reptile': reptile,
}
GRADIENT_UPDATES = frozenset({'fomaml'})
"""Updates that step through the outer Adam, with learning rate beta."""


def _mean_weight(experts: Sequence[Expert], name: str) -> torch.Tensor:
    # In float64, so that the mean of equal weights is that weight, to the bit.
    weights = torch.stack([expert.result.agent.state_dict()[name] for expert in experts])
    return weights.double().mean(dim=0).to(weights.dtype)
