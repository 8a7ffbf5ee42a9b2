"""The inner loop U^K: gradient steps from base weights to expert weights (paper, equation 5)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
import math
from typing import Any

import torch

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.training.optimizers import make_optimizer, OptimizerName
from metagcttt_core.training.step import gradient_step


class AdaptationCancelled(Exception):
    """The caller asked an adaptation to stop before its end."""


@dataclass(frozen=True)
class InnerLoopResult:
    """The expert and how it came about.

    Attributes:
        agent: The copy of the base agent with the weights of the best step.
        train_losses: (K,) loss of each step's batch before the step.
        test_losses: (K + 1,) loss of the test batch after 0..K steps; empty without a test batch.
        best_step: k* (paper, equation 9): the step whose weights `agent` has.
    """

    agent: Agent
    train_losses: list[float]
    test_losses: list[float]
    best_step: int


def run_inner_loop(
    base: Agent,
    batches: Iterable[TensorBatch],
    *,
    lr: float,
    optimizer: OptimizerName = 'adam',
    optimizer_state: dict[int, dict[str, Any]] | None = None,
    test_batch: TensorBatch | None = None,
    actor_only: bool = False,
    should_stop: Callable[[], bool] | None = None,
) -> InnerLoopResult:
    """Adapt a copy of `base`, one gradient step per batch; `base` is not changed.

    Args:
        base: The agent to start from.
        batches: The train batches, one per step.
        lr: Inner learning rate alpha.
        optimizer: Name of the inner optimiser.
        optimizer_state: Moments and step count to begin with; fresh by default.
        test_batch: With it, the test loss is taken after 0..K steps and the result has the
            weights of the smallest one, the earliest on ties (test-aware early stopping). A
            non-finite loss never wins.
        actor_only: Train the actor and leave the rest.
        should_stop: Asked before every step.

    Raises:
        AdaptationCancelled: When `should_stop` returned true.
    """
    agent = base.clone()
    parameters = list(agent.trained_parameters(actor_only=actor_only))
    stepper = make_optimizer(optimizer, parameters, lr, optimizer_state)
    train_losses: list[torch.Tensor] = []
    test_losses: list[float] = []
    best_step, best_loss, best_weights = 0, float('inf'), None

    def test(step: int, batch: TensorBatch) -> None:
        nonlocal best_step, best_loss, best_weights
        with torch.no_grad():
            loss = agent.losses(batch, actor_only=actor_only)[0].item()
        test_losses.append(loss)
        rank = loss if math.isfinite(loss) else math.inf
        if step == 0 or rank < best_loss:
            best_step, best_loss = step, rank
            best_weights = [tensor.detach().clone() for tensor in agent.state_dict().values()]

    step = 0
    if test_batch is not None:
        test(step, test_batch)
    for step, batch in enumerate(batches, start=1):
        if should_stop is not None and should_stop():
            raise AdaptationCancelled(f'cancelled before inner step {step}')
        loss, _ = gradient_step(agent, stepper, parameters, batch, actor_only=actor_only)
        train_losses.append(loss)
        if test_batch is not None:
            test(step, test_batch)

    stepper.zero_grad()
    if best_weights is not None:
        with torch.no_grad():
            for tensor, best in zip(agent.state_dict().values(), best_weights, strict=True):
                tensor.copy_(best)
    return InnerLoopResult(
        agent=agent,
        train_losses=torch.stack(train_losses).tolist() if train_losses else [],
        test_losses=test_losses,
        best_step=step if test_batch is None else best_step,
    )
