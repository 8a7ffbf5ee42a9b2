"""How long the runs of a study take, by rates measured on this machine."""

from collections.abc import Sequence
from functools import cache
import math
import time
from typing import TYPE_CHECKING

from metagcttt_core import TrajectoryDataset
from metagcttt_core.agents.config import ActorLoss
import numpy as np
from sim_bridge import make_simulator

from metagcttt_tools.common.results import markdown_table

if TYPE_CHECKING:
    from metagcttt_core import Agent

    from metagcttt_tools.evaluate import EvaluateSettings
    from metagcttt_tools.meta_train import MetaTrainSettings
    from metagcttt_tools.pretrain import PretrainSettings

_STEPS, _ROWS = 20, 2000  # measured, and of the data that stand for a dataset


def format_estimate(
    pretraining: Sequence['PretrainSettings'],
    post_training: Sequence['MetaTrainSettings'],
    evaluations: Sequence['EvaluateSettings'],
    processes: int,
) -> str:
    """What is left of each run as a Markdown table, and the sum.

    Only gradient steps, held-out losses and control steps count. Evaluations are counted as if no
    episode ended before its limit, so theirs is an upper bound.

    Args:
        pretraining: Runs of pre-training, of one agent and environment.
        post_training: Runs of post-training.
        evaluations: Evaluations that are not done.
        processes: Runs at the same time.
    """
    from metagcttt_core.training.checkpoint import steps_done

    rates = Rates(pretraining[0])
    rows = []
    for run in pretraining:
        left = run.training.steps - steps_done(run.checkpoint_folder)
        seconds = left * rates.gradient_step(run.training.batch_size)
        rows.append((f'pretrain {run.out.name}', left, seconds))
    for train in post_training:
        meta = train.meta
        left = meta.outer_steps - steps_done(train.checkpoint_folder)
        held_out = meta.max_test if meta.early_stopping else 0
        step = rates.gradient_step(meta.batch_size, held_out, train.actor_loss)
        seconds = left * meta.meta_batch_size * meta.inner_steps * step
        rows.append((f'meta-train {train.out.name}', left, seconds))
    for evaluation in evaluations:
        episodes, seconds = _evaluation(evaluation, rates)
        rows.append((f'evaluate {evaluation.out.stem}', episodes, seconds))
    hours = sum(seconds for *_, seconds in rows) / 3600
    table = markdown_table(
        [
            {'run': name, 'steps or episodes left': left, 'hours': seconds / 3600}
            for name, left, seconds in rows
        ]
    )
    return (
        f'{table}\n\n{hours:.3g} hours of one core at most, '
        f'{hours / processes:.3g} with {processes} processes'
    )


def _evaluation(settings: 'EvaluateSettings', rates: 'Rates') -> tuple[int, float]:
    """Episodes of an evaluation and the seconds they take at most."""
    ttt = settings.ttt
    held_out = ttt.max_test if ttt.early_stopping else 0  # a guard's two batches are not counted
    step = rates.gradient_step(ttt.batch_size, held_out, settings.actor_loss)
    spec = rates.simulator.spec
    limit = spec.max_episode_steps
    adaptations = math.ceil(limit / ttt.horizon) if ttt.horizon else 1
    each_budget = (
        len(settings.checkpoints) * len(settings.seeds) * spec.num_tasks * settings.episodes
    )
    gradient_steps = each_budget * adaptations * sum(settings.budgets)
    episodes = each_budget * len(settings.budgets)
    return episodes, gradient_steps * step + episodes * limit * rates.control_step


class Rates:
    """Seconds of the steps of a study, measured with one thread on random data."""

    def __init__(self, run: 'PretrainSettings') -> None:
        """Of the agent and the environment of a run of pre-training."""
        self._run = run
        self.simulator = make_simulator(run.maze)
        spec, rng = self.simulator.spec, np.random.default_rng(0)
        terminals = np.zeros(_ROWS, bool)
        terminals[-1] = True
        self._dataset = TrajectoryDataset.from_arrays(
            rng.normal(size=(_ROWS, spec.obs_dim)).astype(np.float32),
            rng.uniform(-1, 1, (_ROWS, spec.act_dim)).astype(np.float32),
            terminals,
        )
        self.gradient_step = cache(self._gradient_step)
        self.control_step = self._control_step()

    def _agent(self, actor_loss: ActorLoss | None = None) -> 'Agent':
        from metagcttt_core import make_agent

        changes = {} if actor_loss is None else {'actor_loss': actor_loss}
        return make_agent(
            self._run.agent,
            obs_dim=self._dataset.obs_dim,
            act_dim=self._dataset.act_dim,
            hidden=self._run.hidden,
            seed=0,
            **(self._run.agent_settings | changes),
        )

    def _gradient_step(
        self, batch_size: int, held_out: int = 0, actor_loss: ActorLoss | None = None
    ) -> float:
        """Seconds of an inner step, with the held-out loss of so many transitions after it."""
        from metagcttt_core.adaptation.batches import QueryBatches
        from metagcttt_core.adaptation.inner_loop import run_inner_loop

        agent, rng = self._agent(actor_loss), np.random.default_rng(0)
        goal = self._dataset.observations[0]
        batches = QueryBatches(agent, self._dataset, np.arange(_ROWS), goal)
        test = batches.sample(held_out, rng) if held_out else None
        seconds = []
        for _ in range(2):  # the first warms up
            began = time.perf_counter()
            run_inner_loop(agent, batches.steps(_STEPS, batch_size, rng), lr=1e-9, test_batch=test)
            seconds.append(time.perf_counter() - began)
        return seconds[-1] / _STEPS

    def _control_step(self) -> float:
        """Seconds of a control step with the policy's action."""
        from metagcttt_core.evaluation.rollout import run_episode

        agent = self._agent()
        began = time.perf_counter()
        episode = run_episode(agent, self.simulator, task_id=1, seed=0)
        return (time.perf_counter() - began) / episode.steps
