"""Diagnostics of post-training: k*, losses, drift, support sizes (paper, figure 8)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from metagcttt_core.agents.agent import Agent
from metagcttt_core.meta.report import OuterStep, TaskReport


@dataclass(frozen=True)
class Record:
    """Figures of some outer steps, by name.

    Attributes:
        means: Means over the tasks, None where there are no values; and the drift.
        samples: One value per task: k*, support size, redraws.
        curves: Mean loss over the inner steps (paper, figure 8).
    """

    means: dict[str, float | None]
    samples: dict[str, list[int]]
    curves: dict[str, list[float]]


class Diagnostics:
    """Collects outer steps into records."""

    def __init__(self, initial: Agent) -> None:
        """Measure drift from the weights of `initial`."""
        self._initial = [weight.detach().clone() for weight in initial.state_dict().values()]
        self._tasks: list[TaskReport] = []

    def add(self, outer: OuterStep) -> None:
        """Add an outer step to the next record."""
        self._tasks += outer.tasks

    def record(self, agent: Agent) -> Record:
        """A record of the steps added since the last one, with the drift of `agent`."""
        tasks, self._tasks = self._tasks, []
        means = {**_means(tasks), 'meta/drift': self._drift(agent)}
        samples = {
            'inner/best_steps': [task.best_step for task in tasks],
            'task/support_sizes': [task.num_transitions for task in tasks],
            'task/redraw_counts': [task.redraws for task in tasks],
        }
        curves = {
            'inner/train_loss_curve': [task.train_losses for task in tasks],
            'inner/test_loss_curve': [task.test_losses for task in tasks if task.test_losses],
        }
        return Record(
            means,
            samples,
            {name: np.mean(lines, axis=0).tolist() for name, lines in curves.items() if lines},
        )

    def _drift(self, agent: Agent) -> float:
        weights = agent.state_dict().values()
        squared = [(a - b).square().sum() for a, b in zip(weights, self._initial, strict=True)]
        return float(torch.stack(squared).sum().sqrt())


def _means(tasks: Sequence[TaskReport]) -> dict[str, float | None]:
    tested = [task.test_losses for task in tasks if task.test_losses]
    return {
        'inner/best_step': _mean([task.best_step for task in tasks]),
        'inner/rejected': _mean([task.best_step == 0 for task in tasks]),
        'inner/one_step': _mean([task.best_step == 1 for task in tasks]),
        'inner/first_train_loss': _mean([task.train_losses[0] for task in tasks]),
        'inner/last_train_loss': _mean([task.train_losses[-1] for task in tasks]),
        'inner/first_test_loss': _mean([losses[0] for losses in tested]),
        'inner/best_test_loss': _mean([min(losses) for losses in tested]),
        'inner/last_test_loss': _mean([losses[-1] for losses in tested]),
        'inner/initial_loss': _mean([task.initial_loss for task in tasks]),
        'inner/expert_loss': _mean([task.expert_loss for task in tasks]),
        'task/support_transitions': _mean([task.num_transitions for task in tasks]),
        'task/mean_steps': _mean([task.mean_steps for task in tasks]),
        'task/redraws': _mean([task.redraws for task in tasks]),
        'task/filter_ms': _mean([task.filter_ms for task in tasks]),
    }


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
