"""What a deployed policy consists of, and how it answers a query. No ROS in here."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from metagcttt_core import (
    adapt,
    Adaptation,
    Agent,
    FilterConfig,
    load_checkpoint,
    SupportSet,
    TrajectoryDataset,
    TrajectoryFilter,
    TTTConfig,
)
from metagcttt_core.config.assets import assets_dir
import numpy as np
from numpy.typing import NDArray

ASSETS = 'pointmaze-medium-navigate'


@dataclass(frozen=True)
class Deployment:
    """A base policy and the indexed dataset it adapts on; they fit together."""

    agent: Agent
    trajectory_filter: TrajectoryFilter

    @property
    def dataset(self) -> TrajectoryDataset:
        """The dataset behind the filter."""
        return self.trajectory_filter.dataset


@dataclass(frozen=True)
class Outcome:
    """The answer to one query; `support` is None when no adaptation was asked for."""

    support: SupportSet | None
    adaptation: Adaptation


def checkpoint_path(path: str) -> Path:
    """`path`, or the committed post-trained policy when it is empty."""
    return Path(path).expanduser() if path else assets_dir() / ASSETS / 'meta'


def dataset_path(path: str) -> Path:
    """`path`, or the committed dataset when it is empty."""
    return Path(path).expanduser() if path else assets_dir() / ASSETS / 'dataset.npz'


def load_deployment(checkpoint: str, dataset: str, config: FilterConfig) -> Deployment:
    """Load and index what a policy needs.

    Args:
        checkpoint: Folder of the checkpoint; empty for the committed one.
        dataset: File of the dataset; empty for the committed one.
        config: How sub-trajectories are chosen.

    Raises:
        FileNotFoundError: If the committed assets are asked for and missing.
        ValueError: If a file is missing or damaged, or the two do not fit together.
    """
    checkpoint_folder, dataset_file = checkpoint_path(checkpoint), dataset_path(dataset)
    agent = load_checkpoint(checkpoint_folder)
    data = TrajectoryDataset.load(dataset_file)
    if (agent.obs_dim, agent.act_dim) != (data.obs_dim, data.act_dim):
        raise ValueError(
            f'the checkpoint {checkpoint_folder} is for observations of {agent.obs_dim} and '
            f'actions of {agent.act_dim} values, the dataset {dataset_file} has {data.obs_dim} '
            f'and {data.act_dim}'
        )
    return Deployment(agent, TrajectoryFilter(data, config))


def answer_query(
    deployment: Deployment,
    observation: NDArray[np.float64],
    goal: NDArray[np.float64],
    config: TTTConfig,
    seed: int,
    should_stop: Callable[[], bool],
    on_step: Callable[[int], None] = lambda steps_done: None,
) -> Outcome:
    """Filter and adapt for one query, as an evaluation episode does.

    Args:
        deployment: Policy and dataset; not changed.
        observation: Current observation, shape (obs_dim,).
        goal: Goal observation, shape (obs_dim,).
        config: Inner loop; 0 steps ask for the base policy.
        seed: Of everything random in the inner loop.
        should_stop: Asked before every step.
        on_step: Called before every step with the number of steps done.

    Raises:
        AdaptationCancelled: If `should_stop` returned true.
    """
    agent, trajectory_filter = deployment.agent, deployment.trajectory_filter
    if config.steps == 0:
        reason = 'adaptation is switched off (0 steps)'
        return Outcome(None, Adaptation(agent, [], [], 0, False, reason, 0.0))
    steps_done = count()

    def stop_or_go_on() -> bool:
        stop = should_stop()
        if not stop:
            on_step(next(steps_done))
        return stop

    support = trajectory_filter.query(observation, goal, agent.value_fn)
    return Outcome(
        support,
        adapt(
            agent,
            deployment.dataset,
            support,
            goal,
            config,
            seed=seed,
            should_stop=stop_or_go_on,
        ),
    )
