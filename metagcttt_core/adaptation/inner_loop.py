"""The inner loop U^K: gradient steps from base weights to expert weights (paper, equation 5)."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
import math

import torch
from torch.profiler import record_function

from metagcttt_core.adaptation.result import Adaptation, AdaptationCancelled, OnStep
from metagcttt_core.agents.agent import Agent, OptimizerState, TensorBatch
from metagcttt_core.training.config import EngineName, OptimizerName, Precision
from metagcttt_core.training.engine import make_engine
from metagcttt_core.training.optimizers import make_optimizer

INNER_STEP, TEST_LOSS = 'inner step', 'test loss'
"""Names of the ranges that `torch.profiler` sees."""


def run_inner_loop(
    base: Agent,
    batches: Iterable[TensorBatch],
    *,
    lr: float,
    optimizer: OptimizerName = 'adam',
    optimizer_state: OptimizerState | None = None,
    test_batch: TensorBatch | None = None,
    actor_only: bool = False,
    engine: EngineName = 'eager',
    precision: Precision = 'float32',
    should_stop: Callable[[], bool] | None = None,
    on_step: OnStep | None = None,
) -> Adaptation:
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
        engine: What computes the steps; `auto` equals `eager` to rounding and is faster.
        precision: Of the matrix products; see `make_engine`.
        should_stop: Asked before every step.
        on_step: Called after every step.

    Raises:
        AdaptationCancelled: When `should_stop` returned true.
    """
    agent = base.clone()
    parameters = list(agent.trained_parameters(actor_only=actor_only))
    stepper = make_optimizer(optimizer, parameters, lr, optimizer_state)
    steps = make_engine(
        engine, agent, stepper, parameters, actor_only=actor_only, precision=precision
    )
    best = None if test_batch is None else BestStep(agent, partial(steps.test_loss, test_batch))
    train_losses: list[torch.Tensor] = []
    for step, batch in enumerate(batches, start=1):
        if should_stop is not None and should_stop():
            raise AdaptationCancelled(f'cancelled before inner step {step}')
        with record_function(INNER_STEP):
            loss, parts = steps.step(batch)
        train_losses.append(loss)
        if on_step is not None:
            on_step(step, {'total': loss, **parts})
        if best is not None:
            best.test(step)
    stepper.zero_grad()
    if best is not None:
        best.restore()
    return Adaptation(
        agent=agent,
        train_losses=torch.stack(train_losses).tolist() if train_losses else [],
        test_losses=[] if best is None else best.losses,
        best_step=len(train_losses) if best is None else best.step,
        engine=steps.name,
    )


class BestStep:
    """Test-aware early stopping (paper, equation 9).

    Attributes:
        losses: The test losses so far.
        step: k*, the step of the smallest one.
    """

    def __init__(self, agent: Agent, test_loss: Callable[[], torch.Tensor]) -> None:
        """Take the test loss of `agent` as it is, after no steps."""
        self._test_loss = test_loss
        self._weights = [weight.detach() for weight in agent.parameters()]
        self._best_weights = [weight.clone() for weight in self._weights]
        self._smallest = math.inf
        self.losses: list[float] = []
        self.step = 0
        self.test(0)

    @torch.no_grad()
    def test(self, step: int) -> None:
        """Take the test loss after `step` steps and keep the weights if they are the best."""
        with record_function(TEST_LOSS):
            loss = self._test_loss().item()
        self.losses.append(loss)
        if math.isfinite(loss) and loss < self._smallest:
            self.step, self._smallest = step, loss
            _copy(self._weights, self._best_weights)

    def restore(self) -> None:
        """Give the agent the weights of the best step."""
        _copy(self._best_weights, self._weights)


@torch.no_grad()
def copy_weights(source: Agent, target: Agent) -> None:
    """Give `target` the weights of `source`, an agent of the same shape."""
    _copy(list(source.parameters()), list(target.parameters()))


def _copy(weights: Sequence[torch.Tensor], into: Sequence[torch.Tensor]) -> None:
    torch._foreach_copy_(list(into), list(weights))
