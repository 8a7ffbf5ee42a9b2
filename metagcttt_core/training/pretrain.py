"""Offline pre-training: minimise an agent's loss on relabelled batches of the dataset."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

from metagcttt_core.agents.agent import Agent
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.training.config import Precision, PretrainConfig
from metagcttt_core.training.engine import make_engine
from metagcttt_core.training.numerics import loss_function
from metagcttt_core.training.optimizers import make_optimizer
from metagcttt_core.training.run import TrainingRun
from metagcttt_core.training.step import gradient_step


def pretrain(
    agent: Agent,
    dataset: TrajectoryDataset,
    config: PretrainConfig,
    seed: int = 0,
    *,
    precision: Precision = 'float32',
    compiled: bool = False,
    run: TrainingRun | None = None,
    on_step: Callable[[int, dict[str, torch.Tensor], Agent], Any] = lambda *_: None,
) -> Agent:
    """Pre-train a copy of `agent`.

    Args:
        agent: Where to start.
        dataset: The offline dataset D.
        config: Steps, learning rate, batch size.
        seed: Of the batches.
        precision: Of the matrix products; see `loss_function`.
        compiled: Compile the loss, by autograd; see `loss_function`. Without, see `make_engine`.
        run: Checkpoints and resume.
        on_step: Told the number of steps done, the losses before the last of them (detached
            tensors) and the agent after it.

    Returns:
        The trained copy, with the optimiser's state.

    Raises:
        DatasetError: If the data are none for the agent; see `Agent.check`.
    """
    agent.check(dataset)
    agent = agent.clone()
    run = run or TrainingRun('pretrain', {})
    relabeller = agent.relabeller(dataset)
    parameters = list(agent.trained_parameters())
    optimizer = make_optimizer('adam', parameters, config.lr)
    start = run.restore(agent, optimizer)
    take_step = make_engine('auto', agent, optimizer, parameters, precision=precision).step
    if compiled:
        losses = loss_function(agent, precision=precision, compiled=True)
        take_step = partial(gradient_step, agent, optimizer, parameters, losses=losses)
    for step in range(start, config.steps):
        batch = relabeller.sample(config.batch_size, np.random.default_rng((seed, step)))
        loss, parts = take_step(agent.tensors(batch))
        agent.optimizer_state = optimizer.state_dict()['state']
        on_step(step + 1, {'loss': loss, **parts}, agent)
        run.step_done(agent, optimizer, step + 1, config.steps)
    return agent
