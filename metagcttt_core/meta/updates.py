"""The meta-updates: from adapted experts back to the base policy (paper, section 4).

Each takes the base agent, changed in place, and one `Expert` per task of the meta-batch that this
process adapted to; means are over the tasks of all processes. Adding one is a function and a line
in `registry.py`.
"""

from collections.abc import Callable, Sequence
from itertools import islice

import torch

from metagcttt_core.agents.agent import Agent
from metagcttt_core.meta.config import MetaConfig
from metagcttt_core.meta.experts import Expert
from metagcttt_core.meta.parallel import mean_over_tasks
from metagcttt_core.meta.second_order import meta_gradient

MetaUpdate = Callable[[Agent, Sequence[Expert], MetaConfig, torch.optim.Optimizer | None], None]


@torch.no_grad()
def continual(
    base: Agent,
    experts: Sequence[Expert],
    config: MetaConfig,
    optimizer: torch.optim.Optimizer | None = None,
) -> None:
    """CONTINUAL-TTT: theta <- mean of the adapted weights."""
    for weight, mean in zip(base.state_dict().values(), _mean_weights(experts), strict=True):
        weight.copy_(mean)


@torch.no_grad()
def reptile(
    base: Agent,
    experts: Sequence[Expert],
    config: MetaConfig,
    optimizer: torch.optim.Optimizer | None = None,
) -> None:
    """TT-REPTILE: theta <- theta + beta (mean of the adapted weights - theta)."""
    for weight, mean in zip(base.state_dict().values(), _mean_weights(experts), strict=True):
        weight.add_(config.outer_lr * (mean - weight))


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


def _step_down_the_mean(
    gradient: Callable[[Expert], Sequence[torch.Tensor]],
    base: Agent,
    experts: Sequence[Expert],
    config: MetaConfig,
    optimizer: torch.optim.Optimizer | None,
) -> None:
    """Step the base with the mean of the experts' gradients; its target networks follow.

    With `rejected='reject'` experts of k* = 0 are left out of the mean, and where no task of the
    meta-batch has another one there is no step.
    """
    if optimizer is None:
        raise ValueError(f'{config.algorithm} needs an outer optimizer')
    parameters = list(base.trained_parameters(actor_only=config.actor_only))
    # The weights of the tasks are summed with their gradients, over all processes.
    *means, weight = mean_over_tasks(
        _weighted(gradient(expert), float(config.rejected != 'reject' or expert.result.accepted))
        for expert in experts
    )
    if weight == 0:
        return
    for parameter, mean in zip(parameters, means, strict=True):
        parameter.grad = mean / weight
    if not config.actor_only:
        base.update_targets()
    optimizer.step()


def _weighted(gradient: Sequence[torch.Tensor], weight: float) -> list[torch.Tensor]:
    return [*(weight * part for part in gradient), gradient[0].new_tensor(weight)]


def _mean_weights(experts: Sequence[Expert]) -> list[torch.Tensor]:
    return mean_over_tasks(list(expert.result.agent.state_dict().values()) for expert in experts)
