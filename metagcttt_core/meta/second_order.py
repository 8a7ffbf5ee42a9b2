"""The gradient of the test loss through the inner loop, for MAML (an extension of the paper)."""

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.func import functional_call

from metagcttt_core.adaptation.functional import AgentLoss
from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.training.config import OptimizerName

_BETA1, _BETA2, _EPS = 0.9, 0.999, 1e-8  # of torch's Adam


def meta_gradient(
    base: Agent,
    train_batches: Iterable[TensorBatch],
    test_batch: TensorBatch,
    *,
    lr: float,
    optimizer: OptimizerName = 'adam',
    actor_only: bool = False,
    first_order: bool = False,
) -> list[Tensor]:
    """Gradient of the test loss after the inner steps with respect to the initial weights.

    Repeats the inner loop as one differentiable function of the initial weights (paper, equation
    6). Target networks follow the weights' values and are constants to the gradient.

    Args:
        base: The agent that holds the initial weights; not changed.
        train_batches: One batch for each inner step.
        test_batch: Batch of the test loss.
        lr: Inner learning rate alpha.
        optimizer: Inner optimiser, with a fresh state.
        actor_only: Train the actor alone.
        first_order: Treat the inner gradients as constants; then this is TT-FOMAML's gradient.

    Returns:
        One tensor for each of `base.trained_parameters`.
    """
    agent = base.clone()
    loss_of = AgentLoss(agent, actor_only)
    trained = {id(weight) for weight in agent.trained_parameters(actor_only=actor_only)}
    names = [name for name, weight in loss_of.named_parameters() if id(weight) in trained]
    own = dict(loss_of.named_parameters())
    initial = [own[name].detach().clone().requires_grad_() for name in names]
    weights, step = list(initial), _STEPS[optimizer](lr)
    for batch in train_batches:
        loss = functional_call(loss_of, dict(zip(names, weights, strict=True)), (batch,))
        gradients = torch.autograd.grad(loss, weights, create_graph=not first_order)
        if not actor_only:
            with torch.no_grad():
                for name, weight in zip(names, weights, strict=True):
                    own[name].copy_(weight)
            agent.update_targets()
        weights = step(weights, gradients)
    loss = functional_call(loss_of, dict(zip(names, weights, strict=True)), (test_batch,))
    return list(torch.autograd.grad(loss, initial))


class _SGD:
    """A differentiable step of gradient descent."""

    def __init__(self, lr: float) -> None:
        self._lr = lr

    def __call__(self, weights: list[Tensor], gradients: tuple[Tensor, ...]) -> list[Tensor]:
        return [w - self._lr * g for w, g in zip(weights, gradients, strict=True)]


class _Adam:
    """A differentiable step of Adam, from a fresh state on."""

    def __init__(self, lr: float) -> None:
        self._lr = lr
        self._count = 0
        self._means: list[Tensor] = []
        self._squares: list[Tensor] = []

    def __call__(self, weights: list[Tensor], gradients: tuple[Tensor, ...]) -> list[Tensor]:
        if not self._means:
            self._means = [torch.zeros_like(weight) for weight in weights]
            self._squares = list(self._means)
        self._count += 1
        self._means = [
            _BETA1 * m + (1 - _BETA1) * g for m, g in zip(self._means, gradients, strict=True)
        ]
        self._squares = [
            _BETA2 * v + (1 - _BETA2) * g * g
            for v, g in zip(self._squares, gradients, strict=True)
        ]
        return [
            w - self._lr * self._corrected(m, _BETA1) / (_root(self._corrected(v, _BETA2)) + _EPS)
            for w, m, v in zip(weights, self._means, self._squares, strict=True)
        ]

    def _corrected(self, moment: Tensor, beta: float) -> Tensor:
        return moment / (1 - beta**self._count)


def _root(values: Tensor) -> Tensor:
    """The square root, with gradient 0 instead of infinity at 0."""
    positive = values > 0
    return torch.where(positive, torch.where(positive, values, 1.0).sqrt(), 0.0)


_STEPS: dict[OptimizerName, type[_SGD] | type[_Adam]] = {'adam': _Adam, 'sgd': _SGD}
