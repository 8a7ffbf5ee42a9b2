"""Experts that were adapted before, for goals and places that come up again. No ROS in here."""

from collections import OrderedDict
from collections.abc import Hashable, Sequence

from metagcttt_core import TTTConfig
import numpy as np
from numpy.typing import NDArray

from metagcttt.policy.deployment import Outcome


class ExpertCache:
    """Keeps the outcomes of the adaptations that were used last.

    Two queries share an expert when the robot's positions are in the same cell of a grid, the
    goals' positions too, and the inner loop has the same settings. It saves the adaptation at the
    price of an expert that was made for a place up to a cell's diagonal away.
    """

    def __init__(self, size: int, cell_m: float, position_dims: Sequence[int]) -> None:
        """Start empty.

        Args:
            size: Most experts to keep; 0 keeps none.
            cell_m: Edge of a cell, metres.
            position_dims: Where a position stands in an observation.
        """
        self._size = size
        self._cell_m = cell_m
        self._position_dims = list(position_dims)
        self._outcomes: OrderedDict[Hashable, Outcome] = OrderedDict()

    def key(
        self, observation: NDArray[np.float64], goal: NDArray[np.float64], config: TTTConfig
    ) -> Hashable:
        """What two queries have in common that share an expert."""
        return (self._cell(observation), self._cell(goal), config.model_dump_json())

    def find(self, key: Hashable) -> Outcome | None:
        """The outcome kept under `key`, which counts as used now."""
        if key in self._outcomes:
            self._outcomes.move_to_end(key)
        return self._outcomes.get(key)

    def keep(self, key: Hashable, outcome: Outcome) -> None:
        """Keep an outcome if there is an expert in it, and drop the one unused for longest."""
        if outcome.adaptation.accepted:
            self._outcomes[key] = outcome
            self._outcomes.move_to_end(key)
            while len(self._outcomes) > self._size:
                self._outcomes.popitem(last=False)

    def __len__(self) -> int:
        """The number of experts kept."""
        return len(self._outcomes)

    def _cell(self, observation: NDArray[np.float64]) -> tuple[float, ...]:
        return tuple(np.floor(observation[self._position_dims] / self._cell_m).tolist())
