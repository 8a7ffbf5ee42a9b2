"""The one map between physical observations and actions and what networks compute with."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.errors import DatasetError

_CHUNK_ROWS = 1 << 16
_ROUNDING = 1e-4
"""Share of a limit by which stored actions may exceed it."""
_FROZEN = 1e-6
"""Deviation of an observed value, relative to its size, from which it counts as constant."""


_LARGEST = 1e15
"""Far beyond any unit; what is scaled by it is still finite in single precision."""


@dataclass(frozen=True, eq=False)
class Scaling:
    """Networks see (observation - origin - mean) / std and give actions as shares of `limit`.

    It belongs to an agent and travels in its checkpoint. The origin is subtracted in double
    precision, which large coordinates such as UTM need.

    Attributes:
        origin: Place from which observations are counted, (obs_dim,) float64, physical units.
        mean: Mean of an observation from there, (obs_dim,) float64.
        std: Its standard deviation, (obs_dim,) float64, above 0.
        limit: The largest action either way, (act_dim,) float64, above 0.
    """

    origin: NDArray[np.float64]
    mean: NDArray[np.float64]
    std: NDArray[np.float64]
    limit: NDArray[np.float64]

    @classmethod
    def identity(cls, obs_dim: int, act_dim: int) -> Self:
        """The scaling that changes nothing."""
        return cls(np.zeros(obs_dim), np.zeros(obs_dim), np.ones(obs_dim), np.ones(act_dim))

    @classmethod
    def of(cls, dataset: TrajectoryDataset, *, standardise: bool = False) -> Self:
        """The scaling for a policy that is trained on a dataset.

        Args:
            dataset: Decides the origin, and the limits where its actions exceed 1.
            standardise: Whether to take mean and deviation from it; a value that never changes
                keeps the deviation 1.
        """
        plain = cls.identity(dataset.obs_dim, dataset.act_dim)
        reach = dataset.action_reach
        limit = np.where(reach > 1 + _ROUNDING, reach, 1.0)
        if not standardise:
            return cls(dataset.origin, plain.mean, plain.std, limit)
        mean = sum(part.sum(0) for part in _parts(dataset.observations)) / dataset.num_rows
        squares = sum(((part - mean) ** 2).sum(0) for part in _parts(dataset.observations))
        std = np.sqrt(squares / dataset.num_rows)
        std = np.where(std > _FROZEN * np.maximum(np.abs(mean), _FROZEN), std, 1.0)
        return cls(dataset.origin, mean, std, limit)

    @classmethod
    def from_json(cls, given: Mapping[str, Any], obs_dim: int, act_dim: int) -> Self:
        """The scaling of a checkpoint; the inverse of `to_json`.

        Raises:
            ValueError: If a part is missing, unknown, of a wrong length or not usable.
        """
        sizes = {'origin': obs_dim, 'mean': obs_dim, 'std': obs_dim, 'limit': act_dim}
        if given.keys() != sizes.keys():
            raise ValueError(f'scaling needs {", ".join(sizes)}, got {", ".join(given)}')
        arrays = {}
        for name, size in sizes.items():
            try:
                arrays[name] = array = np.asarray(given[name], dtype=np.float64)
            except (ValueError, TypeError, OverflowError) as error:
                raise ValueError(f'scaling: {name} must be {size} numbers ({error})') from error
            if array.shape != (size,) or not (np.abs(array) <= _LARGEST).all():
                raise ValueError(f'scaling: {name} must be {size} numbers within {_LARGEST:g}')
        for name in ('std', 'limit'):
            if (arrays[name] < 1 / _LARGEST).any():
                raise ValueError(f'scaling: {name} must be at least {1 / _LARGEST:g}')
        return cls(**arrays)

    def to_json(self) -> dict[str, list[float]]:
        """Plain numbers for a checkpoint, exact."""
        return {each.name: getattr(self, each.name).tolist() for each in fields(self)}

    @property
    def is_identity(self) -> bool:
        """True when it changes neither observations nor actions."""
        return not self._changes_observations and bool((self.limit == 1).all())

    @property
    def _changes_observations(self) -> bool:
        return bool(self.origin.any() or self.mean.any() or (self.std != 1).any())

    def observations(self, values: ArrayLike, origin: ArrayLike = 0.0) -> NDArray[np.float32]:
        """What networks see of observations (..., obs_dim) counted from `origin`."""
        if not self._changes_observations and not np.any(origin):
            return np.asarray(values, dtype=np.float32)
        shift = np.asarray(origin, dtype=np.float64) - self.origin
        exact = np.asarray(values, dtype=np.float64) + shift
        return ((exact - self.mean) / self.std).astype(np.float32)

    def actions(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """What networks see of actions (..., act_dim)."""
        return values if (self.limit == 1).all() else (values / self.limit).astype(values.dtype)

    def physical_actions(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """The actions that networks mean, the inverse of `actions`."""
        return values if (self.limit == 1).all() else (values * self.limit).astype(values.dtype)

    def check(self, dataset: TrajectoryDataset) -> None:
        """Refuse data that a policy with this scaling could not learn from.

        Raises:
            DatasetError: If actions are beyond its limits, or coordinates are so far from its
                origin that single precision would round their changes away.
        """
        where = dataset.source or 'dataset'
        beyond = dataset.action_reach > self.limit * (1 + _ROUNDING)
        if beyond.any():
            dim = int(np.flatnonzero(beyond)[0])
            raise DatasetError(
                f'{where}: actions[:, {dim}] reach {dataset.action_reach[dim]:.3g}, beyond the '
                f'limit of the policy, {self.limit[dim]:.3g}: give a new policy the scaling of '
                'the data (agent.scaling = Scaling.of(dataset)), or scale the actions'
            )
        far = (dataset.origin != 0) & (self.origin == 0)
        if far.any():
            dim = int(np.flatnonzero(far)[0])
            raise DatasetError(
                f'{where}: observations[:, {dim}] are near {dataset.origin[dim]:.6g}, where '
                'single precision loses their changes, and the policy subtracts no origin: give a '
                'new policy the scaling of the data (agent.scaling = Scaling.of(dataset))'
            )


def _parts(observations: NDArray[np.float32]) -> Iterator[NDArray[np.float64]]:
    for start in range(0, len(observations), _CHUNK_ROWS):
        yield observations[start : start + _CHUNK_ROWS].astype(np.float64)
