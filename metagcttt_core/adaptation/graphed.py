"""The inner loop on a GPU: its gradient step captured once as a CUDA graph, then replayed."""

from collections.abc import Callable, Iterable
import itertools

import torch
from torch import Tensor

from metagcttt_core.adaptation.inner_loop import BestStep, copy_weights
from metagcttt_core.adaptation.result import Adaptation
from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.training.config import OptimizerName
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.step import gradient_step

_WARM_UP_STEPS = 3


class GraphedInnerLoop:
    """`run_inner_loop` on a GPU, equal to float tolerance, without launching each kernel anew.

    A graph reads and writes the memory it was captured with: one working copy of the agent, its
    optimiser's state and one batch, all of which are filled before they are used. So every inner
    loop needs the same settings and equally large batches.
    """

    def __init__(
        self,
        base: Agent,
        *,
        lr: float,
        optimizer: OptimizerName = 'adam',
        actor_only: bool = False,
    ) -> None:
        """Prepare inner loops from agents like `base`; see `run_inner_loop`."""
        self._agent = base.clone()
        self._parameters = list(self._agent.trained_parameters(actor_only=actor_only))
        self._optimizer = make_optimizer(optimizer, self._parameters, lr)
        for group in self._optimizer.param_groups:
            group['capturable'] = True
        self._actor_only = actor_only
        self._batch: TensorBatch = {}
        self._replay: Callable[[], None] | None = None
        self._loss = torch.empty(())

    def __call__(
        self, base: Agent, batches: Iterable[TensorBatch], *, test_batch: TensorBatch | None = None
    ) -> Adaptation:
        """Adapt a copy of `base`, one gradient step per batch, from a fresh optimiser state."""
        remaining = iter(batches)
        first = next(remaining)
        if self._replay is None:
            self._capture(first)
        copy_weights(base, self._agent)
        for state in self._optimizer.state.values():
            for moment in state.values():
                moment.zero_()
        best = None if test_batch is None else BestStep(self._agent, self._test_loss(test_batch))
        losses = []
        for step, batch in enumerate(itertools.chain([first], remaining), start=1):
            losses.append(self._step(batch))
            if best is not None:
                best.test(step)
        if best is not None:
            best.restore()
        expert = base.clone()
        copy_weights(self._agent, expert)
        return Adaptation(
            agent=expert,
            train_losses=torch.stack(losses).tolist(),
            test_losses=[] if best is None else best.losses,
            best_step=len(losses) if best is None else best.step,
        )

    def _test_loss(self, batch: TensorBatch) -> Callable[[], Tensor]:
        return lambda: self._agent.losses(batch, actor_only=self._actor_only)[0]

    def _capture(self, batch: TensorBatch) -> None:
        self._batch = {key: values.clone() for key, values in batch.items()}

        def step() -> Tensor:
            return gradient_step(
                self._agent,
                self._optimizer,
                self._parameters,
                self._batch,
                actor_only=self._actor_only,
            )[0]

        self._replay, self._loss = captured(step)

    def _step(self, batch: TensorBatch) -> Tensor:
        assert self._replay is not None
        for key, values in self._batch.items():
            values.copy_(batch[key])
        self._replay()
        return self._loss.clone()


def captured(step: Callable[[], Tensor]) -> tuple[Callable[[], None], Tensor]:
    """A function that repeats `step` on the current GPU, and the tensor of its result.

    The step runs a few times before, on a side stream, as PyTorch's notes on CUDA graphs ask for.
    """
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(_WARM_UP_STEPS):
            step()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = step()
    return graph.replay, result
