"""The meta-updates: from adapted experts back to the base policy (paper, section 4).

Each takes the base agent, changed in place, and one `Expert` per task of the meta-batch. Adding
one is a function and a line in `META_UPDATES`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import islice

import torch

from metagcttt_core.adaptation.inner_loop import InnerLoopResult
from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.meta.config import MetaConfig
from metagcttt_core.meta.second_order import meta_gradient


@dataclass(frozen=True)
class Expert:
    """The outcome of one task's inner loop.

    Attributes:
        result: The adapted copy and its losses.
        test_batch: What scores the copy.
        train_batches: Draws the batches of the inner steps once more.
    """

    result: InnerLoopResult
    test_batch: TensorBatch
    train_batches: Callable[[], Iterable[TensorBatch]]


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

    def gradient(expert: Expert) -> Sequence[torch.Tensor]:
        adapted = list(expert.result.agent.trained_parameters(actor_only=config.actor_only))
        loss, _ = expert.result.agent.losses(expert.test_batch, actor_only=config.actor_only)
        return torch.autograd.grad(loss, adapted)

    _step_down_the_mean(gradient, base, experts, config, optimizer)


def maml(
    base: Agent,
    experts: Sequence[Expert],
    config: MetaConfig,
    optimizer: torch.optim.Optimizer | None = None,
) -> None:
    """MAML: as TT-FOMAML, with the gradient taken through the inner steps (an extension)."""

    def gradient(expert: Expert) -> Sequence[torch.Tensor]:
        return meta_gradient(
            base,
            islice(expert.train_batches(), expert.result.best_step),
            expert.test_batch,
            lr=config.inner_lr,
            optimizer=config.optimizer,
            actor_only=config.actor_only,
        )

    _step_down_the_mean(gradient, base, experts, config, optimizer)


META_UPDATES: dict[str, MetaUpdate] = {
    'continual': continual,
    'fomaml': fomaml,
    'reptile': reptile,
    'maml': maml,
}
GRADIENT_UPDATES = frozenset({'fomaml', 'maml'})
"""Updates that step through the outer Adam, with learning rate beta."""


def _step_down_the_mean(
    gradient: Callable[[Expert], Sequence[torch.Tensor]],
    base: Agent,
    experts: Sequence[Expert],
    config: MetaConfig,
    optimizer: torch.optim.Optimizer | None,
) -> None:
    """Step the base with the mean of the experts' gradients."""
    if optimizer is None:
        raise ValueError(f'{config.algorithm} needs an outer optimizer')
    parameters = list(base.trained_parameters(actor_only=config.actor_only))
    means = [torch.zeros_like(parameter) for parameter in parameters]
    for expert in experts:
        for mean, part in zip(means, gradient(expert), strict=True):
            mean += part / len(experts)
    for parameter, mean in zip(parameters, means, strict=True):
        parameter.grad = mean
    optimizer.step()


def _mean_weight(experts: Sequence[Expert], name: str) -> torch.Tensor:
    # In float64, so that the mean of equal weights is that weight, to the bit.
    weights = torch.stack([expert.result.agent.state_dict()[name] for expert in experts])
    return weights.double().mean(dim=0).to(weights.dtype)
