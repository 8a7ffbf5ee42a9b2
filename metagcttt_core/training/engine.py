"""What computes gradient steps, and which an agent gets."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Literal, Protocol

import torch
from torch import nn, Tensor

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.agents.analytic import AnalyticLoss
from metagcttt_core.kernels import Kernels, KernelsUnavailable, load_kernels
from metagcttt_core.training.config import EngineName, Precision
from metagcttt_core.training.numerics import resolve_precision
from metagcttt_core.training.optimizers import KernelAdam
from metagcttt_core.training.step import gradient_step


class Engine(Protocol):
    """Gradient steps on the weights of one agent.

    Attributes:
        name: `kernels`, `analytic` or `eager`.
    """

    name: str

    def step(self, batch: TensorBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """Take a step; the loss before it and its parts, detached."""

    def test_loss(self, batch: TensorBatch) -> Tensor:
        """The loss of a held-out batch."""


class EagerEngine:
    """The loss and its gradient by autograd, for any agent on any device."""

    name = 'eager'

    def __init__(
        self,
        agent: Agent,
        optimizer: torch.optim.Optimizer,
        parameters: Sequence[nn.Parameter],
        *,
        actor_only: bool,
        precision: Literal['float32', 'bfloat16'] = 'float32',
    ) -> None:
        """Step `parameters` of `agent` with `optimizer`; `bfloat16` is autocast."""
        self._agent, self._optimizer, self._parameters = agent, optimizer, parameters
        self._actor_only = actor_only
        self._autocasts = precision == 'bfloat16'

    def step(self, batch: TensorBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """See `Engine`."""
        return gradient_step(
            self._agent,
            self._optimizer,
            self._parameters,
            batch,
            losses=self._losses,
            actor_only=self._actor_only,
        )

    @torch.no_grad()
    def test_loss(self, batch: TensorBatch) -> Tensor:
        """See `Engine`."""
        return self._losses(batch)[0]

    def _losses(self, batch: TensorBatch) -> tuple[Tensor, dict[str, Tensor]]:
        with torch.autocast(self._agent.device.type, torch.bfloat16, enabled=self._autocasts):
            return self._agent.losses(batch, actor_only=self._actor_only)


class AnalyticEngine:
    """The loss with its gradient written out, which spares autograd and slow products."""

    def __init__(
        self,
        agent: Agent,
        optimizer: torch.optim.Optimizer,
        parameters: Sequence[nn.Parameter],
        loss: AnalyticLoss,
        make_test_loss: Callable[[], AnalyticLoss | None],
        *,
        actor_only: bool,
        kernels: Kernels | None = None,
    ) -> None:
        """Step as `EagerEngine`.

        Args:
            agent: What to train.
            optimizer: Steps `parameters`.
            parameters: Those that get a gradient.
            loss: The loss of `agent`.
            make_test_loss: Gives the same in memory of its own, which is kept for batches of one
                size; called where a test loss is asked for.
            actor_only: Train the actor and leave the rest.
            kernels: What the losses compute with, for Adam's steps too.
        """
        self.name = 'analytic' if kernels is None else 'kernels'
        self._agent = agent
        self._loss, self._make_test_loss = loss, make_test_loss
        self._actor_only = actor_only
        for parameter, gradient in zip(parameters, loss.gradients, strict=True):
            parameter.grad = gradient
        self._step: Callable[[], object] = optimizer.step
        if kernels is not None and isinstance(optimizer, torch.optim.Adam):
            self._step = KernelAdam(optimizer, kernels).step

    def step(self, batch: TensorBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """See `Engine`."""
        loss, parts = self._loss(batch)
        if not self._actor_only:
            self._agent.update_targets()
        self._step()
        return loss, parts

    def test_loss(self, batch: TensorBatch) -> Tensor:
        """See `Engine`."""
        return self._test_loss(batch, backward=False)[0]

    @cached_property
    def _test_loss(self) -> AnalyticLoss:
        loss = self._make_test_loss()
        assert loss is not None
        return loss


def make_engine(
    name: EngineName,
    agent: Agent,
    optimizer: torch.optim.Optimizer,
    parameters: Sequence[nn.Parameter],
    *,
    actor_only: bool = False,
    precision: Precision = 'float32',
) -> Engine:
    """The engine of that name for the gradient steps of `agent`.

    Args:
        name: `auto` is the best that agent and machine have: `kernels`, which need a C compiler or
            what it made before; `analytic`, the same in tensor operations; else `eager`.
        agent: What to train, in place.
        optimizer: Steps `parameters`.
        parameters: `agent.trained_parameters`.
        actor_only: Train the actor and leave the rest.
        precision: Of the matrix products; weights, optimiser and sums are float32.

    Raises:
        ValueError: If the agent or the machine does not have the engine, with the reason.
    """
    resolved = resolve_precision(precision, agent)
    kernels = _kernels_for(name)
    if name != 'eager':
        dtype = torch.bfloat16 if resolved == 'bfloat16' else torch.float32
        make_loss = partial(
            agent.analytic_loss, actor_only=actor_only, dtype=dtype, kernels=kernels
        )
        loss = make_loss()
        if loss is not None:
            return AnalyticEngine(
                agent,
                optimizer,
                parameters,
                loss,
                make_loss,
                actor_only=actor_only,
                kernels=kernels,
            )
        if name != 'auto':
            raise ValueError(
                f'engine {name}: agent {agent.name} has no loss written out for a standard '
                f'deviation that is learned, for other devices than a processor, or at all; '
                'use auto or eager'
            )
    return EagerEngine(agent, optimizer, parameters, actor_only=actor_only, precision=resolved)


def _kernels_for(name: EngineName) -> Kernels | None:
    if name not in ('auto', 'kernels'):
        return None
    try:
        kernels = load_kernels()
        _ = kernels.sgemm
        return kernels
    except KernelsUnavailable as error:
        if name == 'kernels':
            raise ValueError(f'engine kernels: {error}; use auto') from error
        return None
