"""The goal in force, as the goal node decides it and the policy node acts on it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Goal:
    """A goal that was accepted and numbered; the message `GoalQuery` carries it.

    Attributes:
        query_id: Its number.
        episode_id: The only episode in which it counts.
        observation: Full goal observation, shape (obs_dim,), float64.
        xy: Its position in metres.
        seed: Random seed of the adaptation to it.
        world_id: The only world in which it counts; 0 when its states name none.
    """

    query_id: int
    episode_id: int
    observation: NDArray[np.float64]
    xy: tuple[float, float]
    seed: int
    world_id: int = 0
