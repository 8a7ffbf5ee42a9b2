"""The inner loops of many tasks at once: weights with a leading task axis."""

from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor
from torch.func import functional_call, vmap

from metagcttt_core.adaptation.functional import AgentLoss
from metagcttt_core.adaptation.result import Adaptation
from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.training.config import OptimizerName
from metagcttt_core.training.optimizers import make_optimizer


def run_inner_loops(
    base: Agent,
    batches: Sequence[Iterable[TensorBatch]],
    test_batches: Sequence[TensorBatch] | None = None,
    *,
    lr: float,
    optimizer: OptimizerName = 'adam',
    actor_only: bool = False,
) -> list[Adaptation]:
    """The results of `run_inner_loop` for several tasks, equal to float tolerance.

    Adam and gradient descent treat every weight on its own, so one optimiser over stacked weights
    is one optimiser per task. Memory grows with the number of tasks, not with that of steps.

    Args:
        base: The agent that all tasks start from; not changed.
        batches: For each task its train batches, one per step; batches of a step are equally long.
        test_batches: For each task what chooses its best step (test-aware early stopping); they
            may differ in length.
        lr: Inner learning rate alpha.
        optimizer: Name of the inner optimiser, with a fresh state.
        actor_only: Train the actor and leave the rest.
    """
    stack = _Stack(base, len(batches), actor_only)
    stepper = make_optimizer(optimizer, stack.trained, lr)
    best = None if test_batches is None else _BestSteps(stack, test_batches)
    train_losses = []
    for step, task_batches in enumerate(zip(*batches, strict=True), start=1):
        losses = stack.losses(_stacked(task_batches))
        gradients = torch.autograd.grad(losses.sum(), stack.trained)
        for weight, gradient in zip(stack.trained, gradients, strict=True):
            weight.grad = gradient.contiguous()  # fused Adam ignores strides
        if not actor_only:
            stack.agent.update_targets()
        stepper.step()
        train_losses.append(losses.detach())
        if best is not None:
            best.test(step)
    by_task = torch.stack(train_losses, dim=1).tolist()
    if best is None:
        last = len(train_losses)
        return [
            Adaptation(stack.copy_into(base, stack.weights, task), losses, [], last)
            for task, losses in enumerate(by_task)
        ]
    return [
        Adaptation(
            stack.copy_into(base, best.weights, task),
            losses,
            [tested[task] for tested in best.losses],
            best.steps[task],
        )
        for task, losses in enumerate(by_task)
    ]


class _Stack:
    """Copies of an agent, one per task, as one agent whose changing weights are stacked.

    Attributes:
        agent: Its changing weights are (tasks, ...); so its `update_targets` moves all at once.
        weights: Those weights by name.
        trained: Those that an optimiser steps on.
    """

    def __init__(self, base: Agent, count: int, actor_only: bool) -> None:
        self.agent = base.clone()
        prefix = 'actor.' if actor_only else ''
        self.weights = {
            name: weight
            for name, weight in self.agent.named_parameters()
            if name.startswith(prefix)
        }
        for weight in self.weights.values():
            weight.data = weight.data.expand(count, *weight.shape).contiguous()
        self.trained = [weight for weight in self.weights.values() if weight.requires_grad]
        loss = AgentLoss(self.agent, actor_only)

        def loss_of(weights: dict[str, Tensor], batch: TensorBatch) -> Tensor:
            return functional_call(loss, weights, (batch,))

        self._losses = vmap(loss_of)

    def losses(self, batch: TensorBatch, tasks: Tensor | None = None) -> Tensor:
        """The loss of each task's copy on its part of `batch` (tasks, B, ...)."""
        weights = {
            f'agent.{name}': weight if tasks is None else weight[tasks]
            for name, weight in self.weights.items()
        }
        return self._losses(weights, batch)

    @torch.no_grad()
    def copy_into(self, base: Agent, weights: Mapping[str, Tensor], task: int) -> Agent:
        """A copy of `base` with one task's weights."""
        agent = base.clone()
        own = agent.state_dict()
        for name, stacked in weights.items():
            own[name].copy_(stacked[task])
        return agent


class _BestSteps:
    """Test-aware early stopping of each task (paper, equation 9).

    Attributes:
        losses: For each test, the loss of each task.
        steps: k* of each task.
        weights: The weights of those steps, stacked.
    """

    def __init__(self, stack: _Stack, test_batches: Sequence[TensorBatch]) -> None:
        self._stack = stack
        sizes = torch.tensor([len(batch['observations']) for batch in test_batches])
        weight = stack.trained[0]
        # Tasks with equally long test batches are tested together.
        self._groups: list[tuple[Tensor, TensorBatch]] = []
        for size in sizes.unique():
            tasks = (sizes == size).nonzero().squeeze(1)
            batch = _stacked([test_batches[task] for task in tasks])
            self._groups.append((tasks.to(weight.device), batch))
        self._smallest = weight.new_full((len(sizes),), torch.inf)
        self.losses: list[list[float]] = []
        self.steps = [0] * len(sizes)
        self.weights = {name: weight.detach().clone() for name, weight in stack.weights.items()}
        self.test(0)

    @torch.no_grad()
    def test(self, step: int) -> None:
        """Take the test losses after `step` steps and keep the weights that are best so far."""
        losses = torch.empty_like(self._smallest)
        for tasks, batch in self._groups:
            whole = len(tasks) == len(losses)
            losses[tasks] = self._stack.losses(batch, None if whole else tasks)
        self.losses.append(losses.tolist())
        better = losses.isfinite() & (losses < self._smallest)
        self._smallest = torch.where(better, losses, self._smallest)
        tasks = better.nonzero().squeeze(1)
        for name, weight in self._stack.weights.items():
            self.weights[name][tasks] = weight[tasks]
        for task in tasks.tolist():
            self.steps[task] = step


def _stacked(batches: Sequence[TensorBatch]) -> TensorBatch:
    return {key: torch.stack([batch[key] for batch in batches]) for key in batches[0]}
