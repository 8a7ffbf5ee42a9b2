"""The offline dataset D: trajectories in memory or memory-mapped."""

from collections.abc import Mapping
from functools import cached_property
import hashlib
import json
from pathlib import Path
from typing import Any, Self

import numpy as np

from metagcttt_core.data import marks, minari, npz, values
from metagcttt_core.data.errors import DatasetError

CONTRACT = 'contract'
"""Name of the text in an npz file that holds the contract as JSON."""
MADE_FROM = 'made_from'
"""Name of the text in an npz file that says as JSON what the dataset was made from."""


class TrajectoryDataset:
    """Rows of states and actions, trajectories of any length stored back to back.

    A trajectory of T transitions is stored as T + 1 rows; only its last row is terminal and has no
    successor::

        row            0    1    2    3    4    5    6
        observation   s0   s1   s2   s3 | s0   s1   s2
        action        a0   a1   a2   -  | a0   a1   -      ('-': stored, never taken)
        terminal       F    F    F    T |  F    F    T
        episode_starts 0                   4
        episode_ends                  3              6      (inclusive)

    Attributes:
        observations: (N, obs_dim) float32, counted from `origin`; `states` adds it.
        actions: (N, act_dim) float32.
        terminals: (N,) bool, true on the last row of each trajectory.
        extras: Further per-row arrays of the file, such as `qpos` and `qvel`, by name.
        episode_starts: (E,) int64, the first row of each trajectory.
        episode_ends: (E,) int64, the last row of each trajectory (inclusive).
        source: The file it was read from, if any.
        origin: (obs_dim,) float64; zeros but for values such as UTM coordinates, which are so
            large that float32 would round their changes away.
        contract: The robot's contract that the rows satisfy (`Contract.identity`), if any.
        made_from: The program that made it and the files that it read, by name and content, if
            that was recorded; it decides nothing, and `fingerprint` does not count it.
    """

    def __init__(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        terminals: np.ndarray,
        extras: Mapping[str, np.ndarray] | None = None,
        source: Path | None = None,
        *,
        origin: np.ndarray | None = None,
        contract: Mapping[str, Any] | None = None,
    ) -> None:
        """Wrap validated arrays; `from_arrays` and `load` validate them."""
        self.observations = observations
        self.actions = actions
        self.terminals = terminals
        self.extras = dict(extras or {})
        self.source = source
        self.origin = np.zeros(observations.shape[1]) if origin is None else origin
        self.contract = dict(contract) if contract else None
        self.made_from: dict[str, Any] | None = None
        self.episode_ends = np.flatnonzero(terminals).astype(np.int64)
        self.episode_starts = np.concatenate([[0], self.episode_ends[:-1] + 1]).astype(np.int64)
        lengths = np.diff(self.episode_ends, prepend=-1)
        # Set where all trajectories are equally long, so that divisions replace searches.
        self._episode_length = int(lengths[0]) if np.all(lengths == lengths[0]) else None
        # Transitions (rows with a successor) before each trajectory, for drawing one uniformly.
        self._transition_offsets = self.episode_starts - np.arange(len(self.episode_starts))

    @classmethod
    def from_arrays(
        cls,
        observations: np.ndarray,
        actions: np.ndarray,
        terminals: np.ndarray,
        extras: Mapping[str, np.ndarray] | None = None,
        *,
        source: Path | None = None,
        contract: Mapping[str, Any] | None = None,
    ) -> Self:
        """A dataset of the given rows, each of them validated.

        Args:
            observations: (N, obs_dim) real numbers; kept as they are when float32, else converted,
                large coordinates after an origin was subtracted.
            actions: (N, act_dim) real numbers.
            terminals: (N,) of booleans or zeros and ones, true on the last row of each trajectory.
            extras: Further arrays with N rows, kept with the dataset.
            source: The file to name in errors.
            contract: See the attribute.

        Raises:
            DatasetError: For a wrong rank, length or type, a value that is not finite, masked or
                beyond 1e15 (with its row), or a last row that is not terminal.
        """
        where = str(source) if source else 'dataset'
        observations, origin = values.centred(observations, 'observations', where)
        actions = values.matrix(actions, 'actions', where)
        terminals = values.flags(terminals, 'terminals', where)
        extras = {name: np.asanyarray(array) for name, array in (extras or {}).items()}
        rows = len(observations)
        if rows == 0:
            raise DatasetError(f'{where}: observations has no rows')
        for name, array in {'actions': actions, 'terminals': terminals, **extras}.items():
            if array.ndim == 0 or len(array) != rows:
                got = 'a scalar' if array.ndim == 0 else f'{len(array)} rows'
                raise DatasetError(
                    f'{where}: {name} has {got} but observations has {rows}; they must match'
                )
            if array.dtype.hasobject:
                raise DatasetError(f'{where}: {name} holds Python objects, which are never stored')
        if not terminals[-1]:
            raise DatasetError(
                f'{where}: terminals is false on the last row ({rows - 1}); '
                'the last row of every trajectory must be terminal'
            )
        for name, array in extras.items():
            values.finite(array, name, where)
        values.warn_of_oddities(observations, actions, terminals, where)
        return cls(
            observations, actions, terminals, extras, source, origin=origin, contract=contract
        )

    @classmethod
    def load(cls, path: str | Path, *, memory_map: bool | None = None) -> Self:
        """Read a dataset in OGBench's npz format, or a Minari dataset.

        Trajectories end where `terminals` or another of `marks.END_MARKS` says so. Suspicious
        content that can be used is logged: jumps, actions beyond -1 to 1, lost precision.

        Args:
            path: The `.npz` file. Its arrays `observations`, `actions` and `terminals` are
                required. Or the folder or HDF5 file of a Minari dataset; see
                `minari.read_arrays`.
            memory_map: Keep the rows on disk (unpacked once, beside the file) instead of in
                memory. By default, for files that unpack to more than `npz.MEMORY_MAP_BYTES`.
                A Minari dataset is always read into memory.

        Raises:
            DatasetError: If the file is missing, truncated, pickled, or its content is refused by
                `from_arrays`; the message names the file, the field and the row.
        """
        path = Path(path)
        if minari.is_minari(path):
            arrays = minari.read_arrays(path)
        else:
            arrays = npz.read_arrays(
                path, required=('observations', 'actions', 'terminals'), memory_map=memory_map
            )
        ends = marks.take_ends(arrays, str(path))
        observations, actions = arrays.pop('observations'), arrays.pop('actions')
        shape = observations.shape
        following = {
            name: arrays.pop(name)
            for name in list(arrays)
            if marks.is_following(name)
            and (name == 'next_observations' or arrays[name].shape == shape)
        }
        contract = made_from = None
        if not minari.is_minari(path):
            contract, made_from = (npz.read_json(path, name) for name in (CONTRACT, MADE_FROM))
        extras = values.without_gaps(arrays, str(path))
        dataset = cls.from_arrays(
            observations, actions, ends, extras, source=path, contract=contract
        )
        dataset.made_from = made_from
        for name, states in following.items():
            states = states - dataset.origin if dataset.origin.any() else states
            marks.following_rows(dataset.observations, states, ends, name, str(path))
        return dataset

    def save(self, path: str | Path) -> None:
        """Write the dataset as OGBench's compressed npz, atomically; the inverse of `load`."""
        npz.write_arrays(
            Path(path),
            {
                **self.about,
                'observations': self.states(slice(None)),
                'actions': self.actions,
                'terminals': self.terminals,
                **self.extras,
            },
        )

    @property
    def about(self) -> dict[str, np.ndarray]:
        """What files keep beside the rows: texts by name, each a JSON object."""
        texts = {CONTRACT: self.contract, MADE_FROM: self.made_from}
        return {name: np.array(json.dumps(text)) for name, text in texts.items() if text}

    def states(self, rows: int | slice | np.ndarray) -> np.ndarray:
        """The observations of rows as a robot gives them: float32, or float64 with an origin."""
        return (
            self.observations[rows] + self.origin if self.origin.any() else self.observations[rows]
        )

    @cached_property
    def action_reach(self) -> np.ndarray:
        """The largest absolute value of each dimension of an action, (act_dim,) float64."""
        largest = [np.abs(part).max(axis=0) for _, part in values.chunks(self.actions)]
        return np.max(largest, axis=0).astype(np.float64)

    @property
    def num_rows(self) -> int:
        """Number of stored rows N."""
        return len(self.observations)

    @property
    def num_episodes(self) -> int:
        """Number of trajectories E."""
        return len(self.episode_ends)

    @property
    def num_transitions(self) -> int:
        """Number of rows that have a successor, N - E."""
        return self.num_rows - self.num_episodes

    @property
    def obs_dim(self) -> int:
        """Width of an observation."""
        return self.observations.shape[1]

    @property
    def act_dim(self) -> int:
        """Width of an action."""
        return self.actions.shape[1]

    @cached_property
    def fingerprint(self) -> str:
        """Hash of observations, actions, terminals and contract, 16 hexadecimal digits."""
        digest = hashlib.blake2b(digest_size=8)
        for array in (self.observations, self.actions, self.terminals):
            digest.update(f'{array.dtype.str}{array.shape}'.encode())
            for _, part in values.chunks(array):
                digest.update(np.ascontiguousarray(part).data)
        if self.origin.any():
            digest.update(self.origin.data)
        if self.contract:
            digest.update(json.dumps(self.contract, sort_keys=True).encode())
        return digest.hexdigest()

    def episode_of(self, rows: np.ndarray) -> np.ndarray:
        """The trajectory number of each row, int64 of the same shape."""
        if self._episode_length:
            return rows // self._episode_length
        return np.searchsorted(self.episode_ends, rows, side='left')

    def transition_rows(self, numbers: np.ndarray) -> np.ndarray:
        """Rows of the transitions with the given running numbers in [0, num_transitions)."""
        if self._episode_length and self._episode_length > 1:
            return numbers + numbers // (self._episode_length - 1)
        return numbers + np.searchsorted(self._transition_offsets, numbers, side='right') - 1

    def sample_transitions(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Rows drawn uniformly among those that have a successor, (count,) int64.

        Raises:
            DatasetError: If every trajectory is a single state.
        """
        if self.num_transitions == 0:
            raise DatasetError(
                f'{self.source or "dataset"}: no transitions, every trajectory is a single state'
            )
        return self.transition_rows(rng.integers(self.num_transitions, size=count))

    def __repr__(self) -> str:
        """Sizes at a glance."""
        return (
            f'TrajectoryDataset({self.num_episodes} trajectories, {self.num_rows} rows, '
            f'obs_dim={self.obs_dim}, act_dim={self.act_dim})'
        )
