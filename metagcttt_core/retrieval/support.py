"""The support set: the transitions that the filter chose for one task."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class SupportSet:
    """Transitions of the dataset worth adapting on for one (state, goal) task.

    Per kept trajectory, in ascending order of the rows: `episodes`, `segments` and `scores`.

    Attributes:
        indices: (M,) int64, ascending rows of the dataset; empty when nothing fits the task.
        segments: (start, stop) rows of each kept sub-trajectory, stop excluded.
        episodes: (kept,) int64, the trajectory number of each segment.
        scores: (kept,) float64, the optimality score of each segment; higher is better.
        num_relevant: Trajectories with a state near the task's state; all trajectories where the
            variant does not ask for that.
        num_scored: Relevant trajectories that could be scored, of which the best were kept.
        milliseconds: Time the query took.
    """

    indices: np.ndarray
    segments: list[tuple[int, int]]
    episodes: np.ndarray
    scores: np.ndarray
    num_relevant: int
    num_scored: int
    milliseconds: float = 0.0

    @property
    def num_kept(self) -> int:
        """Number of kept sub-trajectories."""
        return len(self.segments)

    @property
    def num_dropped(self) -> int:
        """Relevant trajectories that could not be scored, such as those that miss the goal."""
        return self.num_relevant - self.num_scored

    @property
    def num_transitions(self) -> int:
        """Number of transitions M."""
        return len(self.indices)

    def __len__(self) -> int:
        """Number of transitions M; a support without any is false."""
        return len(self.indices)

    def __eq__(self, other: object) -> bool:
        """Equality of everything but the query time."""
        if not isinstance(other, SupportSet):
            return NotImplemented
        return (
            np.array_equal(self.indices, other.indices)
            and self.segments == other.segments
            and np.array_equal(self.episodes, other.episodes)
            and np.array_equal(self.scores, other.scores)
            and self.num_relevant == other.num_relevant
            and self.num_scored == other.num_scored
        )

    def without_rows(self, excluded: np.ndarray) -> 'SupportSet':
        """The same support without the rows where `excluded` (N,) is true."""
        return replace(self, indices=self.indices[~excluded[self.indices]])

    def split(
        self,
        test_fraction: float = 0.2,
        max_test: int | None = 128,
        seed: int | np.random.Generator = 0,
    ) -> tuple['SupportSet', 'SupportSet']:
        """A random train split that adapts and a disjoint test split that scores the result.

        Args:
            test_fraction: Fraction of the transitions held out, rounded, at least one.
            max_test: The test split is thinned to this many transitions.
            seed: Random seed.

        Returns:
            (train, test), both with ascending indices; test is empty when there are fewer than two
            transitions.
        """
        if not 0 < test_fraction < 1:
            raise ValueError(f'test_fraction must be in (0, 1), got {test_fraction}')
        shuffled = np.random.default_rng(seed).permutation(self.indices)
        num_test = 0
        if len(self) >= 2:
            num_test = min(max(1, round(test_fraction * len(self))), len(self) - 1)
        train, test = shuffled[num_test:], shuffled[:num_test][:max_test]
        return replace(self, indices=np.sort(train)), replace(self, indices=np.sort(test))
