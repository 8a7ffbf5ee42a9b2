"""State-goal tasks sampled from the dataset, with their filtered, split data."""

from dataclasses import dataclass

import numpy as np

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.retrieval.support import SupportSet
from metagcttt_core.retrieval.trajectory_filter import TrajectoryFilter, ValueFunction

_MAX_REDRAWS = 10_000


class TaskError(ValueError):
    """No usable task in the dataset, or too few tasks for the processes."""


@dataclass(frozen=True)
class MetaTask:
    """One task of the outer loop.

    Attributes:
        goal: (obs_dim,) the goal g.
        train: The split to adapt on.
        test: The split that scores the adapted copy; never empty.
        num_transitions: Size of the filtered dataset.
        mean_steps: Mean length of the kept sub-trajectories, in transitions.
        redraws: State-goal pairs discarded before this one because the filter found too little.
    """

    goal: np.ndarray
    train: SupportSet
    test: SupportSet
    num_transitions: int
    mean_steps: float
    redraws: int


class TaskSampler:
    """Draws tasks with s and g uniform over the dataset (paper, Algorithm 1, lines 3 to 6).

    Most of them are near: with `candidates`, the longest of that many is taken, for the test tasks
    are longer than nearly all that are drawn.
    """

    def __init__(
        self,
        trajectory_filter: TrajectoryFilter,
        test_fraction: float,
        max_test: int,
        candidates: int = 1,
    ) -> None:
        """Hold out `test_fraction` of each support, up to `max_test` transitions."""
        self._filter = trajectory_filter
        self._test_fraction = test_fraction
        self._max_test = max_test
        self._candidates = candidates

    def sample(self, rng: np.random.Generator, value_fn: ValueFunction | None = None) -> MetaTask:
        """One task whose filtered dataset can be split; others are redrawn.

        Raises:
            TaskError: If no drawn pair of states has usable data between them.
        """
        drawn = [self._draw(rng, value_fn) for _ in range(self._candidates)]
        return max(drawn, key=lambda task: task.mean_steps)

    def _draw(self, rng: np.random.Generator, value_fn: ValueFunction | None) -> MetaTask:
        dataset: TrajectoryDataset = self._filter.dataset
        for redraws in range(_MAX_REDRAWS):
            state, goal = dataset.states(rng.integers(dataset.num_rows, size=2))
            support = self._filter.query(state, goal, value_fn)
            support = support.without_rows(dataset.terminals)
            train, test = support.split(self._test_fraction, self._max_test, rng)
            if len(test):
                mean_steps = len(support) / support.num_kept
                return MetaTask(goal, train, test, len(support), mean_steps, redraws)
        raise TaskError(
            f'none of {_MAX_REDRAWS} random state-goal pairs has trajectories between them: '
            'use a larger epsilon, or a critic-based filter for short trajectories'
        )
