"""The transitions that a learner draws from, and how steps become transitions."""

from typing import Any

import numpy as np
import torch
from torch import Tensor


class ReplayBuffer:
    """The latest transitions of a run; a new one takes the place of the oldest when it is full.

    Attributes:
        arrays: The transitions by name, one row each; rows from `size` on are not in use.
        added: Number of transitions so far, those that are gone included.
    """

    def __init__(self, capacity: int, obs_dim: int, act_dim: int) -> None:
        """Reserve the memory."""
        shapes: dict[str, tuple[int, ...]] = {
            'observations': (obs_dim,),
            'actions': (act_dim,),
            'next_observations': (obs_dim,),
            'rewards': (),
            'masks': (),
        }
        self.arrays = {
            name: np.empty((capacity, *shape), np.float32) for name, shape in shapes.items()
        }
        self.capacity = capacity
        self.added = 0

    @property
    def size(self) -> int:
        """Number of transitions there are."""
        return min(self.added, self.capacity)

    def add(self, **transition: Any) -> None:
        """Append one transition."""
        for name, array in self.arrays.items():
            array[self.added % self.capacity] = transition[name]
        self.added += 1

    def extend(self, **transitions: np.ndarray) -> None:
        """Append many transitions, one a row."""
        count = len(transitions['rewards'])
        rows = np.arange(self.added, self.added + count) % self.capacity
        for name, array in self.arrays.items():
            array[rows] = transitions[name]
        self.added += count

    def sample(self, count: int, rng: np.random.Generator) -> dict[str, Tensor]:
        """Draw transitions uniformly, with replacement."""
        idxs = rng.integers(self.size, size=count)
        return {
            name: torch.from_numpy(array.take(idxs, axis=0)) for name, array in self.arrays.items()
        }

    def tensors(self) -> dict[str, Tensor]:
        """The transitions so far, by name; they share the memory."""
        rows = {
            f'replay.{name}': torch.from_numpy(array[: self.size])
            for name, array in self.arrays.items()
        }
        return {**rows, 'replay.added': torch.tensor(self.added)}

    def load_tensors(self, tensors: dict[str, Tensor]) -> None:
        """Take over what `tensors` gave."""
        for name, array in self.arrays.items():
            rows = tensors[f'replay.{name}']
            array[: len(rows)] = rows
        self.added = int(tensors['replay.added'])


class Returns:
    """Turns the steps of robots side by side into transitions over several steps.

    A transition that meets the end of an episode or direction is shorter. Its mask carries the
    discount of all steps but one, as the learner discounts one.
    """

    def __init__(
        self, steps: int, robots: int, obs_dim: int, act_dim: int, discount: float
    ) -> None:
        """Start without a step.

        Args:
            steps: Steps of a whole transition.
            robots: Number of robots.
            obs_dim: Numbers in an observation.
            act_dim: Numbers in an action.
            discount: Discount per step.
        """
        self._discounts = discount ** np.arange(steps)[:, None]
        shape = steps, robots  # the latest step first
        self.arrays = {
            'observations': np.zeros((*shape, obs_dim), np.float32),
            'actions': np.zeros((*shape, act_dim), np.float32),
            'rewards': np.zeros(shape, np.float32),
            'open': np.zeros(shape, bool),
        }

    def add(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        next_observations: np.ndarray,
        fallen: np.ndarray,
        cut: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Take a step of each robot; returns the transitions it completes, one a row."""
        newest = {'observations': observations, 'actions': actions, 'rewards': 0, 'open': True}
        for name, array in self.arrays.items():
            array[1:] = array[:-1].copy()
            array[0] = newest[name]
        self.arrays['rewards'] += self._discounts * rewards
        complete = self.arrays['open'] & cut
        complete[-1] |= self.arrays['open'][-1]
        ages, robots = np.nonzero(complete)
        self.arrays['open'][complete] = False
        return {
            'observations': self.arrays['observations'][complete],
            'actions': self.arrays['actions'][complete],
            'rewards': self.arrays['rewards'][complete],
            'masks': self._discounts[ages, 0] * ~fallen[robots],
            'next_observations': next_observations[robots],
        }
