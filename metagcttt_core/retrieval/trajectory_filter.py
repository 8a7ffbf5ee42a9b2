"""filter(D, s, g): the trajectories that matter for a state and a goal."""

from collections.abc import Callable
from functools import partial
import time

import numpy as np

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.retrieval.config import FilterConfig, FilterSettings
from metagcttt_core.retrieval.peaks import ranges
from metagcttt_core.retrieval.registry import VARIANTS
from metagcttt_core.retrieval.spatial_index import Ball, SpatialIndex
from metagcttt_core.retrieval.support import SupportSet
from metagcttt_core.retrieval.value_cache import ValueCache, ValueFunction
from metagcttt_core.retrieval.variants import Task

__all__ = ['TrajectoryFilter', 'ValueFunction']


class TrajectoryFilter:
    """Selects support sets from a dataset (paper, appendix A).

    The index is built once; a query then touches only states near s and near g, and evaluates the
    critic only on states of relevant trajectories.
    """

    def __init__(
        self,
        dataset: TrajectoryDataset,
        config: FilterSettings | None = None,
    ) -> None:
        """Index `dataset` by its positions.

        Args:
            dataset: The offline dataset D.
            config: Selection rule and its settings; what `FilterSettings`, the default, leave out
                is that of the dataset's contract.

        Raises:
            ValueError: If a position dimension is not one of the dataset's observation dimensions,
                or `scale` does not fit them.
        """
        self.dataset = dataset
        self.config: FilterConfig = (config or FilterSettings()).on(dataset.contract)
        if max(self.config.position_dims) >= dataset.obs_dim:
            raise ValueError(
                f'position_dims {self.config.position_dims} must be below the width of an '
                f'observation, which is {dataset.obs_dim} in this dataset'
            )
        dims, scale = self.config.position_dims, self.config.scale
        episodes = dataset.episode_of(np.arange(dataset.num_rows))
        cell_size = self.config.cell_size
        self._index = SpatialIndex(dataset.observations, dims, scale, cell_size, episodes)
        self._value_cache = ValueCache(dataset)

    @property
    def index_bytes(self) -> int:
        """Memory that the spatial index holds."""
        return self._index.num_bytes

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
        place, target = state - self.dataset.origin, goal - self.dataset.origin
        dims, epsilon = list(self.config.position_dims), self.config.epsilon
        task = Task(
            dataset=self.dataset,
            near_state=Ball(self._index, place[dims], epsilon),
            near_goal=Ball(self._index, target[dims], epsilon),
            value=None if value_fn is None else partial(self._value_cache.values, value_fn, goal),
            value_known=value_fn is not None and self._value_cache.is_complete(value_fn, goal),
        )
        found = VARIANTS[self.config.variant](task, self.config)
        starts = found.starts[found.keep]
        stops = np.maximum(starts, found.stops[found.keep])
        return SupportSet(
            indices=ranges(starts, stops),
            segments=list(zip(starts.tolist(), stops.tolist(), strict=True)),
            episodes=found.episodes[found.keep],
            scores=found.scores[found.keep].astype(np.float64),
            num_relevant=found.num_relevant,
            num_scored=len(found.scores),
            milliseconds=1e3 * (time.perf_counter() - began),
        )

    def query_batch(
        self,
        states: np.ndarray,
        goals: np.ndarray,
        value_fn: ValueFunction | None = None,
    ) -> list[SupportSet]:
        """The support sets of many tasks, (n, obs_dim) states and goals; see `query`."""
        if np.shape(states) != np.shape(goals) or np.ndim(states) != 2:
            raise ValueError(
                f'states and goals must both have shape (n, {self.dataset.obs_dim}), '
                f'got {np.shape(states)} and {np.shape(goals)}'
            )
        return [
            self.query(state, goal, value_fn) for state, goal in zip(states, goals, strict=True)
        ]

    def prefetch_values(
        self,
        value_fn: ValueFunction,
        goal: np.ndarray,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Evaluate V towards `goal` everywhere, so that later queries of that goal are quick.

        Meant for a background thread between two adaptations of an episode.

        Returns:
            Whether it was finished before `should_stop` returned true.
        """
        return self._value_cache.prefetch(value_fn, self._checked('goal', goal), should_stop)

    def nearest_row(self, position: np.ndarray) -> int:
        """The row whose position is nearest to `position` (position dims,), the first on ties."""
        position = np.asarray(position, np.float64)
        if position.shape != (len(self.config.position_dims),) or not np.isfinite(position).all():
            raise ValueError(
                f'position must be {len(self.config.position_dims)} finite numbers, got {position}'
            )
        dims = list(self.config.position_dims)
        return self._index.nearest(position - self.dataset.origin[dims])

    def _checked(self, name: str, values: np.ndarray) -> np.ndarray:
        array = np.asarray(values, dtype=np.float64)
        if array.shape != (self.dataset.obs_dim,):
            raise ValueError(
                f'{name} must have shape ({self.dataset.obs_dim},), got {array.shape}'
            )
        if not np.isfinite(array).all():
            raise ValueError(f'{name} holds a non-finite value: {array}')
        return array
