"""What a deployed policy consists of, and how it answers a query. No ROS in here."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count

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
from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_core.config.assets import checkpoint_path, dataset_path
from metagcttt_core.retrieval.value_cache import ValueFunction
import numpy as np
from numpy.typing import NDArray


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


@dataclass(frozen=True)
class _StoppableValue:
    """A critic whose evaluation, which takes seconds for a large dataset, can be given up.

    Equal to that of another query when the critic is, so that values are remembered.
    """

    value_fn: ValueFunction
    should_stop: Callable[[], bool] = field(compare=False)

    def __call__(self, observations: np.ndarray, goal: np.ndarray) -> np.ndarray:
        if self.should_stop():
            raise AdaptationCancelled('cancelled while the critic was evaluated')
        return self.value_fn(observations, goal)


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
        should_stop: Asked before every step, and between evaluations of the critic.
        on_step: Called before every step with the number of steps done.

    Raises:
        AdaptationCancelled: If `should_stop` returned true.
    """
    agent, trajectory_filter = deployment.agent, deployment.trajectory_filter
    if config.steps == 0:
        reason = 'adaptation is switched off (0 steps)'
        return Outcome(None, Adaptation(agent, reason=reason))
    steps_done = count()

    def stop_or_go_on() -> bool:
        stop = should_stop()
        if not stop:
            on_step(next(steps_done))
        return stop

    value_fn = agent.value_fn and _StoppableValue(agent.value_fn, should_stop)
    support = trajectory_filter.query(observation, goal, value_fn)
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


def prefetch_values(
    deployment: Deployment, goal: NDArray[np.float64], should_stop: Callable[[], bool]
) -> None:
    """Evaluate the critic towards `goal` everywhere, so that the next query of it is quick.

    Args:
        deployment: Policy and dataset; the policy has a critic.
        goal: Goal observation, shape (obs_dim,).
        should_stop: Asked now and then.
    """
    value_fn = deployment.agent.value_fn
    assert value_fn is not None, 'policies without a critic have nothing to foresee'
    remembered = _StoppableValue(value_fn, should_stop=lambda: False)
    deployment.trajectory_filter.prefetch_values(remembered, goal, should_stop)


def warm_up(deployment: Deployment) -> None:
    """Take one gradient step and discard it; policy and dataset are not changed.

    PyTorch imports and initialises for a second or two at the first step, which would stall the
    control loop.
    """
    observation = np.asarray(deployment.dataset.observations[0], dtype=np.float64)
    agent, trajectory_filter = deployment.agent, deployment.trajectory_filter
    support = trajectory_filter.query(observation, observation, agent.value_fn)
    config = TTTConfig(steps=1, batch_size=2)
    adapt(agent, deployment.dataset, support, observation, config)
    agent.act(observation, observation)
