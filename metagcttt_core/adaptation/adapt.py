"""Test-time training: from a base policy to the expert for one query (paper, section 3.2)."""

from collections.abc import Callable
from dataclasses import replace
import time

import numpy as np
import torch

from metagcttt_core.adaptation.batches import QueryBatches
from metagcttt_core.adaptation.config import GuardName, TTTConfig
from metagcttt_core.adaptation.inner_loop import run_inner_loop
from metagcttt_core.adaptation.result import Adaptation, OnStep
from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.retrieval.support import SupportSet
from metagcttt_core.training.optimizers import pretrained_state


def adapt(
    agent: Agent,
    dataset: TrajectoryDataset,
    support: SupportSet,
    goal: np.ndarray,
    config: TTTConfig,
    seed: int = 0,
    *,
    should_stop: Callable[[], bool] | None = None,
    on_step: OnStep | None = None,
) -> Adaptation:
    """Take K steps on the support set, with the actor's goal fixed to the query's goal.

    Args:
        agent: The base agent; its weights are bit-equal afterwards.
        dataset: The dataset that `support` indexes.
        support: From `TrajectoryFilter.query`.
        goal: (obs_dim,) the query's goal g.
        config: K, learning rate, batch size and the rest.
        seed: Of the batches and the held-out split.
        should_stop: Asked before every gradient step; true cancels.
        on_step: Called after every gradient step, with the losses by part.

    Returns:
        The expert and its losses. An empty support, zero steps, weights that became non-finite,
        with early stopping a held-out loss that only got worse or, with a guard, one that did not
        fall give the base agent, not accepted, with the reason.

    Raises:
        AdaptationCancelled: When `should_stop` returned true.
        ValueError: If agent, dataset and goal do not fit together, or the agent has no optimiser
            state to begin with.
    """
    began = time.perf_counter()
    _check(agent, dataset, goal)
    state = None
    if config.optimizer_state == 'pretrained':
        state = pretrained_state(agent, actor_only=config.actor_only)

    def ended(result: Adaptation) -> Adaptation:
        return replace(result, support=support, seconds=time.perf_counter() - began)

    def base(reason: str, result: Adaptation | None = None) -> Adaptation:
        result = result or Adaptation(agent)
        return ended(replace(result, agent=agent, best_step=0, reason=reason))

    if config.steps == 0:
        return base('no adaptation steps were asked for')
    split_seed, batch_seed = np.random.SeedSequence(seed).spawn(2)
    rng = np.random.default_rng(batch_seed)
    train, test = support, None
    if config.early_stopping or config.guard != 'none':
        train, test = support.split(
            config.test_fraction, config.max_test, np.random.default_rng(split_seed)
        )

    def batches_of(part: SupportSet) -> QueryBatches:
        return QueryBatches(
            agent,
            dataset,
            part.indices,
            goal,
            fix_actor_goal=config.fix_actor_goal,
            ratio=config.ratio,
        )

    train_batches = batches_of(train)
    if not len(train_batches.rows):
        return base('the filtered dataset is empty')
    test_batch = None
    if test is not None:
        test_batches = batches_of(test)
        if not len(test_batches.rows):
            return base('the filtered dataset is too small to hold out a test split')
        test_batch = test_batches.all(rng)
    result = run_inner_loop(
        agent,
        train_batches.steps(config.steps, config.batch_size, rng),
        lr=config.lr,
        optimizer=config.optimizer,
        optimizer_state=state,
        test_batch=test_batch if config.early_stopping else None,
        actor_only=config.actor_only,
        engine=config.engine,
        precision=config.precision,
        should_stop=should_stop,
        on_step=on_step,
    )
    if result.best_step == 0:
        return base('the held-out loss never fell below its start', result)
    if not all(torch.isfinite(weight).all() for weight in result.agent.parameters()):
        return base('the adapted weights are not finite', result)
    if test_batch is not None and config.guard != 'none':
        before, after = (
            _held_out(each, test_batch, config.guard, actor_only=config.actor_only)
            for each in (agent, result.agent)
        )
        if not after < before:
            return base(
                f'the held-out {config.guard} went from {before:.4g} to {after:.4g}', result
            )
    return ended(result)


@torch.no_grad()
def _held_out(agent: Agent, batch: TensorBatch, measure: GuardName, *, actor_only: bool) -> float:
    """What a guard compares: the agent's loss, or the negative log-likelihood of the actions."""
    loss, parts = agent.losses(batch, actor_only=actor_only)
    return float(parts['bc'] if measure == 'imitation' else loss)


def _check(agent: Agent, dataset: TrajectoryDataset, goal: np.ndarray) -> None:
    agent.check(dataset)
    if np.shape(goal) != (agent.obs_dim,):
        raise ValueError(f'goal must have shape ({agent.obs_dim},), got {np.shape(goal)}')
    if not np.isfinite(goal).all():
        raise ValueError(f'goal holds a non-finite value: {goal}')
