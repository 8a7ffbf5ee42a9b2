"""The baseline of the retrieval benchmark: the filter as a plain scan of the whole dataset."""

from collections.abc import Callable

from metagcttt_core import TrajectoryDataset
import numpy as np


def scan(
    dataset: TrajectoryDataset,
    state: np.ndarray,
    goal: np.ndarray,
    values: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    epsilon: float = 1.0,
    top_percent: float = 20.0,
) -> np.ndarray:
    """Rows that the paper's filter selects, by looking at every row for every query.

    Args:
        dataset: Trajectories of equal length.
        state: (obs_dim,) s.
        goal: (obs_dim,) g.
        values: The critic, evaluated on every row; critic-free by default.
        epsilon: Locality radius.
        top_percent: Percent of scored trajectories kept.
    """
    num_episodes = dataset.num_episodes
    length = dataset.num_rows // num_episodes
    positions = dataset.observations[:, :2].astype(np.float64)
    to_state = np.sqrt(np.square(positions - state[:2]).sum(axis=1)).reshape(num_episodes, length)
    relevant = np.flatnonzero((to_state <= epsilon).any(axis=1))
    starts = to_state[relevant].argmin(axis=1)
    ahead = np.arange(length) >= starts[:, None]
    if values is None:
        to_goal = np.sqrt(np.square(positions - goal[:2]).sum(axis=1))
        badness = np.where(ahead, to_goal.reshape(num_episodes, length)[relevant], np.inf)
    else:
        everywhere = values(dataset.observations, goal).reshape(num_episodes, length)
        badness = np.where(ahead, -everywhere[relevant], np.inf)
    ends = badness.argmin(axis=1)
    best = badness[np.arange(len(relevant)), ends]
    scored = np.flatnonzero(best <= epsilon) if values is None else np.arange(len(relevant))
    count = max(1, int(np.ceil(top_percent * len(scored) / 100)))
    kept = np.sort(scored[np.argsort(best[scored], kind='stable')[:count]])
    offsets = relevant * length
    last = length - 1  # has no next state
    return np.concatenate(
        [
            np.empty(0, np.int64),
            *(
                np.arange(offsets[k] + starts[k], offsets[k] + min(ends[k] + 1, last))
                for k in kept
            ),
        ]
    )
