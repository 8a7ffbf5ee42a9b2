"""What the paper looks at while post-training: k*, losses, drift, support sizes."""

import torch

from metagcttt_core.agents.agent import Agent
from metagcttt_core.meta.post_train import OuterStep


class OuterStepScalars:
    """Collects outer steps and returns their means by name."""

    def __init__(self, initial: Agent) -> None:
        """Measure drift from the weights of `initial`."""
        self._initial = [weight.detach().clone() for weight in initial.state_dict().values()]
        self._steps: list[OuterStep] = []

    def add(self, outer: OuterStep) -> None:
        """Take an outer step into the next means."""
        self._steps.append(outer)

    def means(self, agent: Agent) -> dict[str, float | None]:
        """Means over the steps added since the last call, and the drift of `agent`."""
        tasks = [task for outer in self._steps for task in outer.tasks]
        results = [result for outer in self._steps for result in outer.results]
        self._steps = []
        best_steps = [result.best_step for result in results]
        weights = agent.state_dict().values()
        squared = [(a - b).square().sum() for a, b in zip(weights, self._initial, strict=True)]
        tested = [result.test_losses for result in results if result.test_losses]
        return {
            'inner/best_step': _mean(best_steps),
            'inner/rejected': _mean([step == 0 for step in best_steps]),
            'inner/first_train_loss': _mean([result.train_losses[0] for result in results]),
            'inner/last_train_loss': _mean([result.train_losses[-1] for result in results]),
            'inner/first_test_loss': _mean([losses[0] for losses in tested]),
            'inner/best_test_loss': _mean([min(losses) for losses in tested]),
            'inner/last_test_loss': _mean([losses[-1] for losses in tested]),
            'task/support_transitions': _mean([task.num_transitions for task in tasks]),
            'task/redraws': _mean([task.redraws for task in tasks]),
            'task/filter_ms': _mean([task.train.milliseconds for task in tasks]),
            'meta/drift': float(torch.stack(squared).sum().sqrt()),
        }


def _mean(values: list) -> float | None:
    return sum(values) / len(values) if values else None
