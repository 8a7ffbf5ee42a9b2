"""Batches for adapting to one query."""

from collections.abc import Iterator

import numpy as np
from torch.profiler import record_function

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.data.dataset import TrajectoryDataset

BATCHES = 'batches'
"""Name of the range that `torch.profiler` sees."""

_GATHERED_STEPS = 64  # at once; bounds the memory of long inner loops


class QueryBatches:
    """Draws batches from a support set with the actor's goal fixed to the query's goal."""

    def __init__(
        self,
        agent: Agent,
        dataset: TrajectoryDataset,
        rows: np.ndarray,
        goal: np.ndarray,
        *,
        fix_actor_goal: float = 1.0,
        ratio: float = 1.0,
    ) -> None:
        """Draw from `rows` of `dataset`; those without a successor are left out.

        Args:
            agent: Whose goal distributions and device to use.
            dataset: The offline dataset.
            rows: (M,) rows of the support.
            goal: (obs_dim,) the query's goal.
            fix_actor_goal: Probability that the actor goal of a support transition is `goal`.
            ratio: Share of a batch drawn from `rows`; the rest comes from the whole dataset.
        """
        self.rows = rows[~dataset.terminals[rows]]
        self._agent = agent
        self._relabeller = agent.relabeller(dataset)
        self._goal = agent.scaling.observations(goal)
        self._fix_actor_goal = fix_actor_goal
        self._ratio = ratio

    def sample(self, batch_size: int, rng: np.random.Generator) -> TensorBatch:
        """A batch drawn with replacement."""
        (batch,) = self.steps(1, batch_size, rng)
        return batch

    def steps(
        self, count: int, batch_size: int, rng: np.random.Generator
    ) -> Iterator[TensorBatch]:
        """The batches of `count` steps, each drawn with replacement.

        They equal as many calls of `sample`; rows are gathered for many steps at once.
        """
        num_support = int(batch_size * self._ratio)
        for first in range(0, count, _GATHERED_STEPS):
            num_steps = min(_GATHERED_STEPS, count - first)
            with record_function(BATCHES):
                draws = [self._draw(batch_size, num_support, rng) for _ in range(num_steps)]
                batches = self._gather(
                    {key: np.stack([draw[key] for draw in draws]) for key in draws[0]}
                )
            for step in range(num_steps):
                yield {key: values[step] for key, values in batches.items()}

    def all(self, rng: np.random.Generator) -> TensorBatch:
        """Every support transition once."""
        with record_function(BATCHES):
            return self._gather(self._with_goals(self.rows, len(self.rows), rng))

    def _draw(
        self, batch_size: int, num_support: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        rows = self.rows[rng.integers(len(self.rows), size=num_support)]
        everywhere = self._relabeller.dataset.sample_transitions(batch_size - num_support, rng)
        return self._with_goals(np.concatenate([everywhere, rows]), num_support, rng)

    def _with_goals(
        self, rows: np.ndarray, num_support: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Rows of transitions and goals, and which actor goals are the query's; each (B,)."""
        drawn = {'rows': rows, **self._relabeller.draw_goals(rows, rng)}
        fixed = np.zeros(len(rows), bool)
        fixed[len(rows) - num_support :] = rng.random(num_support) < self._fix_actor_goal
        return {**drawn, 'fixed': fixed}

    def _gather(self, drawn: dict[str, np.ndarray]) -> TensorBatch:
        fixed = drawn.pop('fixed')
        batch = self._relabeller.gather(**drawn)
        self._relabeller.fix_actor_goals(batch, fixed, self._goal)
        return self._agent.tensors(batch)
