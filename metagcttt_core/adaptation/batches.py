"""Batches for adapting to one query."""

import numpy as np

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.relabel import GoalRelabeller


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
        self._relabeller = GoalRelabeller(dataset, agent.settings.goals, agent.settings.discount)
        self._goal = np.asarray(goal, dtype=np.float32)
        self._fix_actor_goal = fix_actor_goal
        self._ratio = ratio

    def sample(self, batch_size: int, rng: np.random.Generator) -> TensorBatch:
        """A batch drawn with replacement."""
        num_support = int(batch_size * self._ratio)
        rows = self.rows[rng.integers(len(self.rows), size=num_support)]
        everywhere = self._relabeller.dataset.sample_transitions(batch_size - num_support, rng)
        return self._batch(np.concatenate([everywhere, rows]), num_support, rng)

    def all(self, rng: np.random.Generator) -> TensorBatch:
        """Every support transition once."""
        return self._batch(self.rows, len(self.rows), rng)

    def _batch(self, rows: np.ndarray, num_support: int, rng: np.random.Generator) -> TensorBatch:
        batch = self._relabeller.relabel(rows, rng)
        fixed = rng.random(num_support) < self._fix_actor_goal
        batch['actor_goals'][len(rows) - num_support :][fixed] = self._goal
        return self._agent.tensors(batch)
