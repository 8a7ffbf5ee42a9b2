"""A cache of experts, for goals and places that recur."""

from collections import OrderedDict
from collections.abc import Hashable, Sequence

from metagcttt_core import Adaptation, TTTConfig
import numpy as np
from numpy.typing import NDArray


class ExpertCache:
    """Keeps the most recently used adaptations.

    Two goals share an expert when the robot's positions are in the same cell of a grid, the goals'
    positions are too, and the inner loop has the same settings. This saves the adaptation at the
    price of an expert adapted to a place up to a cell's diagonal away.
    """

    def __init__(self, size: int, cell_m: float, position_dims: Sequence[int]) -> None:
        """Create an empty cache.

        Args:
            size: Most experts to keep; 0 keeps none.
            cell_m: Edge of a cell, metres.
            position_dims: Indices of x and y in an observation.
        """
        self._size = size
        self._cell_m = cell_m
        self._position_dims = list(position_dims)
        self._adaptations: OrderedDict[Hashable, Adaptation] = OrderedDict()

    def key(
        self, observation: NDArray[np.float64], goal: NDArray[np.float64], config: TTTConfig
    ) -> Hashable:
        """The key that is equal for goals that share an expert."""
        return (self._cell(observation), self._cell(goal), config.model_dump_json())

    def find(self, key: Hashable) -> Adaptation | None:
        """The adaptation kept under `key`, marked as used now; None when there is none."""
        if key in self._adaptations:
            self._adaptations.move_to_end(key)
        return self._adaptations.get(key)

    def keep(self, key: Hashable, adaptation: Adaptation) -> None:
        """Keep an adaptation if it was accepted, and evict the least recently used one."""
        if adaptation.accepted:
            self._adaptations[key] = adaptation
            self._adaptations.move_to_end(key)
            while len(self._adaptations) > self._size:
                self._adaptations.popitem(last=False)

    def __len__(self) -> int:
        """The number of experts kept."""
        return len(self._adaptations)

    def _cell(self, observation: NDArray[np.float64]) -> tuple[float, ...]:
        return tuple(np.floor(observation[self._position_dims] / self._cell_m).tolist())
