"""Meta-post-training (paper, Algorithm 1): prepare a policy for test-time training."""

from collections.abc import Callable, Iterator
import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from metagcttt_core.adaptation.batches import QueryBatches
from metagcttt_core.adaptation.inner_loop import InnerLoopResult, run_inner_loop
from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.meta.config import MetaConfig
from metagcttt_core.meta.tasks import MetaTask, TaskSampler
from metagcttt_core.meta.updates import Expert, GRADIENT_UPDATES, META_UPDATES
from metagcttt_core.retrieval.trajectory_filter import TrajectoryFilter
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.run import TrainingRun


@dataclass(frozen=True)
class OuterStep:
    """What happened in one outer step, for logs and diagnostics.

    Attributes:
        step: Outer steps done.
        tasks: The meta-batch.
        results: The inner loop of each task.
    """

    step: int
    tasks: list[MetaTask]
    results: list[InnerLoopResult]


def post_train(
    agent: Agent,
    dataset: TrajectoryDataset,
    config: MetaConfig,
    seed: int = 0,
    *,
    run: TrainingRun | None = None,
    on_step: Callable[[OuterStep, Agent], Any] = lambda outer, base: None,
) -> Agent:
    """Post-train a copy of `agent` so that a few steps of test-time training make it an expert.

    Args:
        agent: The pre-trained policy theta_0; not changed.
        dataset: The offline dataset D.
        config: Algorithm, N, K, B, alpha, beta and the rest.
        seed: Of tasks, splits and batches.
        run: Checkpoints and resume.
        on_step: Told about each outer step and the base policy after it.

    Returns:
        The post-trained policy theta.
    """
    base = agent.clone()
    run = run or TrainingRun('post_train', {})
    sampler = TaskSampler(
        TrajectoryFilter(dataset, config.filter), config.test_fraction, config.max_test
    )
    meta_update = META_UPDATES[config.algorithm]
    outer_optimizer = None
    if config.algorithm in GRADIENT_UPDATES:
        parameters = base.trained_parameters(actor_only=config.actor_only)
        outer_optimizer = make_optimizer('adam', parameters, config.meta_lr)

    for step in range(run.restore(base, outer_optimizer), config.outer_steps):
        rng = np.random.default_rng((seed, step))
        tasks = [sampler.sample(rng, base.value_fn) for _ in range(config.meta_batch_size)]
        experts = [adapt_to_task(base, dataset, task, config, rng) for task in tasks]
        meta_update(base, experts, config, outer_optimizer)
        on_step(OuterStep(step + 1, tasks, [expert.result for expert in experts]), base)
        run.step_done(base, outer_optimizer, step + 1, config.outer_steps)
    return base


def adapt_to_task(
    base: Agent,
    dataset: TrajectoryDataset,
    task: MetaTask,
    config: MetaConfig,
    rng: np.random.Generator,
) -> Expert:
    """Lines 7 to 10 of Algorithm 1: K steps from theta on the task's train split."""
    train, test = (
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
    test_batch = test.all(rng)

    def train_batches(rng: np.random.Generator) -> Iterator[TensorBatch]:
        return (train.sample(config.batch_size, rng) for _ in range(config.inner_steps))

    before = copy.deepcopy(rng)
    result = run_inner_loop(
        base,
        train_batches(rng),
        lr=config.inner_lr,
        optimizer=config.optimizer,
        test_batch=test_batch if config.early_stopping else None,
        actor_only=config.actor_only,
    )
    return Expert(result, test_batch, lambda: train_batches(copy.deepcopy(before)))
