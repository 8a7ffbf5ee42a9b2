"""Action fields of the policy before and after an adaptation that the graph reported.

Weights do not travel over the graph. What was adapted on, the seed and the settings do, and the
inner loop is deterministic, so the view takes the same steps again and compares the losses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from metagcttt_core import adapt, Agent, load_checkpoint, SupportSet, TrajectoryDataset, TTTConfig
from metagcttt_core.config.assets import checkpoint_path, dataset_path
import numpy as np
from sim_bridge import MazeMap

_RELATIVE = 1e-3  # other thread counts sum in another order
_PER_CELL = 3


@dataclass(frozen=True)
class Deployed:
    """What the policy node's parameters name: its policy and dataset."""

    agent: Agent
    dataset: TrajectoryDataset

    @property
    def has_field(self) -> bool:
        """True when states are positions and actions are directions, as the point's are."""
        return self.agent.obs_dim == self.agent.act_dim == 2


@dataclass(frozen=True)
class Query:
    """An adaptation as the graph reported it.

    Attributes:
        goal: (obs_dim,) the goal.
        seed: Seed of the inner loop.
        segments: (start, stop) rows of each retrieved sub-trajectory.
        losses: Loss of each step's batch before the step.
    """

    goal: np.ndarray
    seed: int
    segments: Sequence[tuple[int, int]]
    losses: Sequence[float]


def load_deployed(checkpoint: str, dataset: str) -> Deployed:
    """The policy and dataset of these parameters; empty ones are the committed.

    Raises:
        OSError: If a file cannot be read.
        ValueError: If one is missing or damaged.
    """
    return Deployed(
        load_checkpoint(checkpoint_path(checkpoint)), TrajectoryDataset.load(dataset_path(dataset))
    )


def expert_of(
    deployed: Deployed, query: Query, config: TTTConfig, should_stop: Callable[[], bool]
) -> Agent:
    """The expert of a query.

    Args:
        deployed: Policy and dataset.
        query: The reported adaptation.
        config: The inner loop of the policy node.
        should_stop: Asked before every gradient step.

    Raises:
        ValueError: If the losses differ from those reported: other weights or settings.
        AdaptationCancelled: If `should_stop` returned true.
    """
    rows = [np.arange(start, stop) for start, stop in query.segments]
    none = np.zeros(len(rows))
    support = SupportSet(
        indices=np.concatenate(rows),
        segments=list(query.segments),
        episodes=none.astype(np.int64),
        scores=none,
        num_relevant=len(rows),
        num_scored=len(rows),
    )
    adaptation = adapt(
        deployed.agent,
        deployed.dataset,
        support,
        query.goal,
        config,
        query.seed,
        should_stop=should_stop,
    )
    if not _same(adaptation.train_losses, query.losses):
        raise ValueError('the losses differ: the policy has other weights or settings')
    return adaptation.agent


def _same(losses: Sequence[float], reported: Sequence[float]) -> bool:
    return len(losses) == len(reported) and np.allclose(losses, reported, rtol=_RELATIVE)


def grid_of(maze: MazeMap) -> np.ndarray:
    """(n, 2) positions in metres, spread over the free cells; none on a finer map."""
    if maze.unit_m < 1:
        return np.empty((0, 2))
    spread = (np.arange(_PER_CELL) + 0.5) / _PER_CELL - 0.5
    offsets = np.stack(np.meshgrid(spread, spread), -1).reshape(-1, 2) * maze.unit_m
    rows, cols = np.nonzero(~maze.walls)
    centers = np.stack([cols, rows], 1) * maze.unit_m + np.array(maze.origin_xy)
    return (centers[:, None] + offsets).reshape(-1, 2)
