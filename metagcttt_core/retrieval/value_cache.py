"""Cache of V(row | g), so that each dataset row is evaluated once per goal."""

from collections import OrderedDict
from collections.abc import Callable
import threading

import numpy as np

from metagcttt_core.data.dataset import TrajectoryDataset

ValueFunction = Callable[[np.ndarray, np.ndarray], np.ndarray]
_BATCH_ROWS = 8192


class ValueCache:
    """Remembers V(row | g) for the most recent pairs of value function and goal.

    Holds 4 bytes per dataset row for each pair. Value functions must be pure; two that compare
    equal share their values.
    """

    def __init__(self, dataset: TrajectoryDataset, capacity: int = 2) -> None:
        """Remember the values of `capacity` pairs."""
        self._dataset = dataset
        self._capacity = capacity
        self._values: OrderedDict[tuple[ValueFunction, bytes], np.ndarray] = OrderedDict()
        self._complete: set[tuple[ValueFunction, bytes]] = set()
        self._lock = threading.Lock()

    def values(self, value_fn: ValueFunction, goal: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """V of each row (n,), float32; only unknown rows are evaluated.

        Args:
            value_fn: (observations (n, obs_dim), goal (obs_dim,)) -> (n,).
            goal: (obs_dim,).
            rows: (n,) rows of the dataset.

        Raises:
            ValueError: If `value_fn` returns another shape or a non-finite value.
        """
        goal = self._in_precision(goal)
        known = self._known(value_fn, goal)
        values = known[rows]
        unknown = rows[np.isnan(values)]
        for start in range(0, len(unknown), _BATCH_ROWS):
            self._evaluate(value_fn, goal, known, unknown[start : start + _BATCH_ROWS])
        return known[rows] if len(unknown) else values

    def prefetch(
        self,
        value_fn: ValueFunction,
        goal: np.ndarray,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Evaluate V on every row, so that later queries of this goal are fast.

        Meant for a background thread; `should_stop` is polled between batches.

        Returns:
            True if it finished.
        """
        goal = self._in_precision(goal)
        known = self._known(value_fn, goal)
        unknown = np.flatnonzero(np.isnan(known))
        for start in range(0, len(unknown), _BATCH_ROWS):
            if should_stop():
                return False
            self._evaluate(value_fn, goal, known, unknown[start : start + _BATCH_ROWS])
        with self._lock:
            self._complete.add((value_fn, goal.tobytes()))
        return True

    def is_complete(self, value_fn: ValueFunction, goal: np.ndarray) -> bool:
        """True if every row is known since a `prefetch`."""
        key = (value_fn, self._in_precision(goal).tobytes())
        with self._lock:
            return key in self._values and key in self._complete

    def _in_precision(self, goal: np.ndarray) -> np.ndarray:
        """The goal in float32, as observations are, unless these have an origin."""
        return np.asarray(goal, np.float64 if self._dataset.origin.any() else np.float32)

    def _known(self, value_fn: ValueFunction, goal: np.ndarray) -> np.ndarray:
        """The cached values of a pair, NaN where unknown; the oldest pair is evicted."""
        key = (value_fn, goal.tobytes())
        with self._lock:
            if key not in self._values:
                self._values[key] = np.full(self._dataset.num_rows, np.nan, np.float32)
                if len(self._values) > self._capacity:
                    self._complete.discard(self._values.popitem(last=False)[0])
            self._values.move_to_end(key)
            return self._values[key]

    def _evaluate(
        self, value_fn: ValueFunction, goal: np.ndarray, known: np.ndarray, rows: np.ndarray
    ) -> None:
        result = np.asarray(value_fn(self._dataset.states(rows), goal), np.float32)
        if result.shape != rows.shape:
            raise ValueError(f'value_fn must return shape {rows.shape}, got {result.shape}')
        if not np.isfinite(result).all():
            raise ValueError('value_fn returned a non-finite value')
        known[rows] = result
