"""filter(D, s, g): the trajectories that matter for a state and a goal."""

from collections.abc import Callable
from functools import partial
import time

import numpy as np

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.retrieval.config import FilterConfig
from metagcttt_core.retrieval.spatial_index import SpatialIndex
from metagcttt_core.retrieval.support import SupportSet
from metagcttt_core.retrieval.variants import Task, VARIANTS

ValueFunction = Callable[[np.ndarray, np.ndarray], np.ndarray]
_VALUE_BATCH_ROWS = 8192


class TrajectoryFilter:
    """Selects support sets from a dataset (paper, appendix A).

    The index is built once; a query then touches only states near s and near g, and evaluates the
    critic only on states of relevant trajectories.
    """

    def __init__(self, dataset: TrajectoryDataset, config: FilterConfig | None = None) -> None:
        """Index `dataset` by its positions.

        Raises:
            ValueError: If a position dimension is not one of the dataset's observation dimensions.
        """
        self.dataset = dataset
        self.config = config or FilterConfig()
        if max(self.config.position_dims) >= dataset.obs_dim:
            raise ValueError(
                f'position_dims {self.config.position_dims} must be below the width of an '
                f'observation, which is {dataset.obs_dim} in this dataset'
            )
        self._index = SpatialIndex(
            dataset.observations,
            self.config.position_dims,
            self.config.scale,
            cell_size=self.config.epsilon / 2,
        )

    def query(
        self, state: np.ndarray, goal: np.ndarray, value_fn: ValueFunction | None = None
    ) -> SupportSet:
        """The support set D(s, g) of one task.

        Args:
            state: (obs_dim,) current observation s.
            goal: (obs_dim,) goal g.
            value_fn: The critic V: (observations (n, obs_dim), goal (obs_dim,)) -> (n,). With it
                the critic-based form selects, without it the critic-free one.

        Returns:
            The kept sub-trajectories; empty, not an error, when nothing fits.

        Raises:
            ValueError: If `state`, `goal` or what `value_fn` returns has a wrong shape or a
                non-finite value.
        """
        began = time.perf_counter()
        state = self._checked('state', state)
        goal = self._checked('goal', goal)
        dims, epsilon = list(self.config.position_dims), self.config.epsilon
        task = Task(
            dataset=self.dataset,
            near_state=partial(self._index.ball, state[dims], epsilon),
            near_goal=partial(self._index.ball, goal[dims], epsilon),
            value=None if value_fn is None else partial(self._values, value_fn, goal),
        )
        found = VARIANTS[self.config.variant](task, self.config)
        starts, stops = found.starts[found.keep], found.stops[found.keep]
        segments = [(int(a), int(max(a, b))) for a, b in zip(starts, stops, strict=True)]
        return SupportSet(
            indices=np.concatenate(
                [np.empty(0, np.int64), *(np.arange(a, b) for a, b in segments)]
            ),
            segments=segments,
            episodes=found.episodes[found.keep],
            scores=found.scores[found.keep],
            num_relevant=found.num_relevant,
            num_scored=len(found.scores),
            milliseconds=1e3 * (time.perf_counter() - began),
        )

    def nearest_row(self, position: np.ndarray) -> int:
        """The row whose position is nearest to `position` (position dims,), the first on ties."""
        position = np.asarray(position, np.float64)
        if position.shape != (len(self.config.position_dims),) or not np.isfinite(position).all():
            raise ValueError(
                f'position must be {len(self.config.position_dims)} finite numbers, got {position}'
            )
        return self._index.nearest(position)

    def _checked(self, name: str, values: np.ndarray) -> np.ndarray:
        array = np.asarray(values, dtype=np.float64)
        if array.shape != (self.dataset.obs_dim,):
            raise ValueError(
                f'{name} must have shape ({self.dataset.obs_dim},), got {array.shape}'
            )
        if not np.isfinite(array).all():
            raise ValueError(f'{name} holds a non-finite value: {array}')
        return array

    def _values(self, value_fn: ValueFunction, goal: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """V of each row, float64, evaluated in batches."""
        values = np.empty(len(rows), np.float64)
        goal = goal.astype(np.float32)
        for start in range(0, len(rows), _VALUE_BATCH_ROWS):
            batch = rows[start : start + _VALUE_BATCH_ROWS]
            result = np.asarray(value_fn(self.dataset.observations[batch], goal))
            if result.shape != (len(batch),):
                raise ValueError(f'value_fn must return shape ({len(batch)},), got {result.shape}')
            if not np.isfinite(result).all():
                raise ValueError('value_fn returned a non-finite value')
            values[start : start + len(batch)] = result
        return values
