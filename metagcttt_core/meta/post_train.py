"""Meta-post-training (paper, Algorithm 1): prepare a policy for test-time training."""

from collections.abc import Callable
from typing import Any

import numpy as np
from torch.profiler import record_function

from metagcttt_core.agents.agent import Agent
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.meta.config import MetaConfig
from metagcttt_core.meta.experts import adapt_to_tasks, make_inner_loops
from metagcttt_core.meta.health import check_finite
from metagcttt_core.meta.parallel import first_process, own_tasks, reports_of_all
from metagcttt_core.meta.registry import GRADIENT_UPDATES, META_UPDATES
from metagcttt_core.meta.report import OuterStep, TaskReport
from metagcttt_core.meta.tasks import TaskSampler
from metagcttt_core.retrieval.trajectory_filter import TrajectoryFilter
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.run import TrainingRun

INDEX, TASKS, UPDATE = 'index', 'tasks', 'update'
"""Names of the ranges that `torch.profiler` sees."""


def post_train(
    agent: Agent,
    dataset: TrajectoryDataset,
    config: MetaConfig,
    seed: int = 0,
    *,
    run: TrainingRun | None = None,
    on_step: Callable[[OuterStep, Agent], Any] = lambda outer, base: None,
    cuda_graphs: bool = True,
) -> Agent:
    """Post-train a copy of `agent` so that a few steps of test-time training make it an expert.

    With an initialised `torch.distributed` process group, the tasks of a meta-batch are divided
    among its processes; all of them return the same policy.

    Args:
        agent: The pre-trained policy theta_0; not changed.
        dataset: The offline dataset D.
        config: Algorithm, N, K, B, alpha, beta and the rest.
        seed: Of tasks, splits and batches.
        run: Checkpoints and resume.
        on_step: Told about each outer step and the base policy after it, in the first process.
        cuda_graphs: On a GPU, replay captured inner steps where tasks are adapted one by one.

    Returns:
        The post-trained policy theta. Its `optimizer_state` is still that of pre-training: inner
        loops begin with a fresh one (the paper leaves it open), and the outer Adam of TT-FOMAML is
        another optimiser.

    Raises:
        DivergedError: When a loss or a weight is no longer finite. `run` keeps the checkpoint
            before that.
        DatasetError: If the data are none for the agent; see `Agent.check`.
        TaskError: If no task can be found, or there are more processes than tasks.
    """
    agent.check(dataset)
    base = agent.clone()
    run = run or TrainingRun('post_train', {})
    with record_function(INDEX):
        trajectory_filter = TrajectoryFilter(dataset, config.filter)
    sampler = TaskSampler(
        trajectory_filter, config.test_fraction, config.max_test, config.task_candidates
    )
    meta_update = META_UPDATES[config.algorithm]
    outer_optimizer = None
    if config.algorithm in GRADIENT_UPDATES or config.algorithm in META_UPDATES.plugins:
        parameters = base.trained_parameters(actor_only=config.actor_only)
        outer_optimizer = make_optimizer('adam', parameters, config.outer_lr)
    numbers = own_tasks(config.meta_batch_size)
    inner_loops = make_inner_loops(base, config, cuda_graphs=cuda_graphs)

    for step in range(run.restore(base, outer_optimizer), config.outer_steps):
        # A generator for each task, whichever process draws it.
        rngs = [np.random.default_rng((seed, step, number)) for number in numbers]
        value_fn = base.value_fn
        with record_function(TASKS):
            tasks = [sampler.sample(rng, value_fn) for rng in rngs]
        experts = adapt_to_tasks(base, dataset, tasks, config, rngs, inner_loops)
        with record_function(UPDATE):
            meta_update(base, experts, config, outer_optimizer)
        reports = [
            TaskReport.of(
                task,
                expert.result,
                initial_loss=expert.loss_of(agent, config),
                expert_loss=expert.loss_of(expert.result.agent, config),
            )
            for task, expert in zip(tasks, experts, strict=True)
        ]
        outer = OuterStep(step + 1, reports_of_all(reports))
        check_finite(outer, base)
        if first_process():
            on_step(outer, base)
        run.step_done(base, outer_optimizer, step + 1, config.outer_steps)
    return base
