"""Lines 7 to 10 of Algorithm 1: from the tasks of a meta-batch to their experts."""

from collections.abc import Callable, Iterable, Iterator, Sequence
import copy
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from metagcttt_core.adaptation.batches import QueryBatches
from metagcttt_core.adaptation.graphed import GraphedInnerLoop
from metagcttt_core.adaptation.inner_loop import run_inner_loop
from metagcttt_core.adaptation.result import Adaptation
from metagcttt_core.adaptation.stacked import run_inner_loops
from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.meta.config import MetaConfig
from metagcttt_core.meta.tasks import MetaTask

# By autograd on a CPU stacked tasks are faster than one after another, for so many tasks at least
# and rows of a batch times weights at most (`metagcttt benchmark meta --meta.engine eager`).
_FEWEST_STACKED_ON_CPU = 4
_LARGEST_STACKED_ON_CPU = 2_000_000


InnerLoops = Callable[
    [Agent, Sequence[Iterable[TensorBatch]], Sequence[TensorBatch] | None], list[Adaptation]
]
"""From a base agent and, by task, train batches and test batches (if any) to the results."""


@dataclass(frozen=True)
class Expert:
    """The outcome of one task's inner loop.

    Attributes:
        result: The adapted copy and its losses.
        test_batch: What scores the copy.
        train_batches: Draws the batches of the inner steps once more.
    """

    result: Adaptation
    test_batch: TensorBatch
    train_batches: Callable[[], Iterable[TensorBatch]]

    @torch.no_grad()
    def loss_of(self, agent: Agent, config: MetaConfig) -> float:
        """The test loss of an agent on this task."""
        return agent.losses(self.test_batch, actor_only=config.actor_only)[0].item()


def adapt_to_tasks(
    base: Agent,
    dataset: TrajectoryDataset,
    tasks: Sequence[MetaTask],
    config: MetaConfig,
    rngs: Sequence[np.random.Generator],
    inner_loops: InnerLoops,
) -> list[Expert]:
    """K steps from theta on the train split of each task.

    Args:
        base: The base policy theta; not changed.
        dataset: What the tasks index.
        tasks: The meta-batch.
        config: K, alpha and the rest.
        rngs: For each task the source of its batches.
        inner_loops: From `make_inner_loops`.
    """
    data = [
        _TaskData(base, dataset, task, config, rng) for task, rng in zip(tasks, rngs, strict=True)
    ]
    results = inner_loops(
        base,
        [each.train_batches() for each in data],
        [each.test_batch for each in data] if config.early_stopping else None,
    )
    return [
        Expert(result, each.test_batch, each.train_batches)
        for result, each in zip(results, data, strict=True)
    ]


def make_inner_loops(
    base: Agent, config: MetaConfig, *, together: bool | None = None, cuda_graphs: bool = True
) -> InnerLoops:
    """A function that adapts agents like `base` to all tasks of a meta-batch.

    Args:
        base: The agent; its device and size decide what is fastest.
        config: The inner loop's settings.
        together: Adapt all tasks at once; by default where that is faster.
        cuda_graphs: One by one on a GPU, replay a captured step.
    """
    optimizer, lr, actor_only = config.optimizer, config.inner_lr, config.actor_only
    if adapts_together(base, config) if together is None else together:
        return partial(run_inner_loops, lr=lr, optimizer=optimizer, actor_only=actor_only)
    inner_loop: Callable[..., Adaptation]
    if base.device.type == 'cuda' and cuda_graphs and config.precision == 'float32':
        inner_loop = GraphedInnerLoop(base, lr=lr, optimizer=optimizer, actor_only=actor_only)
    else:
        inner_loop = partial(
            run_inner_loop,
            lr=lr,
            optimizer=optimizer,
            actor_only=actor_only,
            engine=config.engine,
            precision=config.precision,
        )

    def one_by_one(
        base: Agent,
        batches: Sequence[Iterable[TensorBatch]],
        test_batches: Sequence[TensorBatch] | None,
    ) -> list[Adaptation]:
        tests: Sequence[TensorBatch | None] = test_batches or [None] * len(batches)
        return [
            inner_loop(base, train, test_batch=test)
            for train, test in zip(batches, tests, strict=True)
        ]

    return one_by_one


def adapts_together(agent: Agent, config: MetaConfig) -> bool:
    """True if adapting the tasks of a meta-batch together is faster."""
    if config.precision != 'float32' or config.engine in ('kernels', 'analytic'):
        return False  # stacks have neither
    if agent.device.type != 'cpu':
        return config.meta_batch_size > 1
    if config.engine == 'auto' and agent.analytic_loss(actor_only=config.actor_only) is not None:
        return False  # gradients written out are faster one task after another
    weights = agent.trained_parameters(actor_only=config.actor_only)
    work = config.batch_size * sum(weight.numel() for weight in weights)
    return config.meta_batch_size >= _FEWEST_STACKED_ON_CPU and work <= _LARGEST_STACKED_ON_CPU


class _TaskData:
    """The test batch of a task and its train batches, drawn as often as asked for."""

    def __init__(
        self,
        base: Agent,
        dataset: TrajectoryDataset,
        task: MetaTask,
        config: MetaConfig,
        rng: np.random.Generator,
    ) -> None:
        self._train, test = (
            QueryBatches(
                base,
                dataset,
                split.indices,
                task.goal,
                fix_actor_goal=config.fix_actor_goal,
                ratio=config.ratio,
            )
            for split in (task.train, task.test)
        )
        self._config = config
        self.test_batch = test.all(rng)
        self._rng = copy.deepcopy(rng)

    def train_batches(self) -> Iterator[TensorBatch]:
        """The batches of the K inner steps; the same ones every time."""
        rng = copy.deepcopy(self._rng)
        return self._train.steps(self._config.inner_steps, self._config.batch_size, rng)
