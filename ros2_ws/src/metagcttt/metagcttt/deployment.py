"""A base policy with the dataset it adapts on, and its adaptation to a goal."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

from metagcttt_core import (
    adapt,
    Adaptation,
    Agent,
    load_checkpoint,
    TrajectoryDataset,
    TrajectoryFilter,
    TTTConfig,
)
from metagcttt_core.adaptation import AdaptationCancelled, OnStep
from metagcttt_core.adaptation.inner_loop import run_inner_loop
from metagcttt_core.config.assets import checkpoint_path, dataset_path
from metagcttt_core.retrieval import FilterSettings
from metagcttt_core.retrieval.value_cache import ValueFunction
from metagcttt_core.robot import identity_fault
from metagcttt_core.training.config import EngineName
from metagcttt_core.training.optimizers import pretrained_state
import numpy as np
from numpy.typing import NDArray

from metagcttt.goal_in_force import Goal


@dataclass(frozen=True)
class Identity:
    """What decides, besides goal, state, seed and inner loop, which expert comes out.

    Attributes:
        checkpoint: Fingerprint of the base policy: weights, scaling, settings, optimiser state.
        dataset: Fingerprint of the dataset.
        filter: Settings of the filter as JSON.
    """

    checkpoint: str
    dataset: str
    filter: str


@dataclass(frozen=True)
class Deployment:
    """A base policy and the indexed dataset it adapts on; they fit together."""

    agent: Agent
    trajectory_filter: TrajectoryFilter

    @cached_property
    def identity(self) -> Identity:
        """Its identity; reads all weights and rows the first time."""
        return Identity(
            checkpoint=self.agent.fingerprint(),
            dataset=self.dataset.fingerprint,
            filter=self.trajectory_filter.config.model_dump_json(),
        )

    @property
    def contract(self) -> Mapping[str, Any] | None:
        """The identity of the robot's contract that they were made for, if any."""
        return self.agent.metadata.get('contract') or self.dataset.contract

    def contract_fault(self, fingerprint: str) -> str:
        """Why a state of the contract with that fingerprint is none for them; empty if it is."""
        met = {'robot': 'the robot of the state', 'fingerprint': fingerprint}
        return identity_fault('the policy', self.contract, met if fingerprint else None)

    @property
    def dataset(self) -> TrajectoryDataset:
        """The dataset behind the filter."""
        return self.trajectory_filter.dataset

    def check_optimizer_state(self, choice: str) -> None:
        """Refuse to begin adaptations with a state that the checkpoint does not have.

        Raises:
            ValueError: Names the checkpoint and what to do.
        """
        if choice == 'pretrained':
            pretrained_state(self.agent)

    def check_engine(self, name: EngineName) -> None:
        """Refuse an engine that policy or machine do not have.

        Raises:
            ValueError: With the reason.
        """
        run_inner_loop(self.agent, [], lr=0.0, engine=name)


@dataclass(frozen=True)
class _CancellableValue:
    """A critic whose evaluation, which takes seconds for a large dataset, can be cancelled.

    Two of the same critic are equal, so that values are cached across adaptations.
    """

    value_fn: ValueFunction
    should_stop: Callable[[], bool] = field(compare=False)

    def __call__(self, observations: np.ndarray, goal: np.ndarray) -> np.ndarray:
        if self.should_stop():
            raise AdaptationCancelled('cancelled while the critic was evaluated')
        return self.value_fn(observations, goal)


def load_deployment(checkpoint: str, dataset: str, settings: FilterSettings) -> Deployment:
    """Load a policy, and load and index its dataset.

    Args:
        checkpoint: Folder of the checkpoint; empty for the committed one.
        dataset: File of the dataset; empty for the committed one.
        settings: Selection of sub-trajectories; what they leave out is that of the contract of
            the data or else of the policy.

    Raises:
        FileNotFoundError: If the committed assets are asked for and missing.
        ValueError: If a file is missing or damaged, or the two do not fit together.
    """
    checkpoint_folder, dataset_file = checkpoint_path(checkpoint), dataset_path(dataset)
    agent = load_checkpoint(checkpoint_folder)
    data = TrajectoryDataset.load(dataset_file)
    agent.check(data)
    made_for = data.contract or agent.metadata.get('contract')
    return Deployment(agent, TrajectoryFilter(data, settings.on(made_for)))


class Values(Protocol):
    """Values by name, such as the parameters of a node."""

    def __getitem__(self, name: str) -> Any:
        """The value of that name."""


def deployment_of(parameters: Values) -> Deployment:
    """Load what a node's parameters name; see `load_deployment`."""
    settings = FilterSettings(
        variant=parameters['filter_variant'],
        epsilon=parameters['epsilon'] or None,
        top_percent=parameters['top_percent'],
    )
    return load_deployment(parameters['checkpoint'], parameters['dataset'], settings)


def warm_up(deployment: Deployment, config: TTTConfig) -> str:
    """Take one gradient step, as `config` will, and discard it; no goal waits for it later.

    At the first step PyTorch imports and initialises for a second or two, and kernels that this
    machine does not have yet are compiled.

    Returns:
        The engine that took it.

    Raises:
        ValueError: If policy or machine do not have the engine that is asked for.
    """
    agent, dataset = deployment.agent, deployment.dataset
    observation = np.asarray(dataset.states(0), dtype=np.float64)
    deployment.trajectory_filter.query(observation, observation, agent.value_fn)
    batch = agent.relabeller(dataset).sample(config.batch_size, np.random.default_rng(0))
    step = run_inner_loop(
        agent,
        [agent.tensors(batch)],
        lr=config.lr,
        actor_only=config.actor_only,
        engine=config.engine,
        precision=config.precision,
    )
    agent.act(observation, observation)
    return step.engine


def adapt_to_goal(
    deployment: Deployment,
    observation: NDArray[np.float64],
    goal: Goal,
    config: TTTConfig,
    should_stop: Callable[[], bool],
    on_step: OnStep | None = None,
) -> Adaptation:
    """Filter the dataset for a goal and adapt, as an evaluation episode does.

    Args:
        deployment: Policy and dataset; not changed.
        observation: Current observation, shape (obs_dim,).
        goal: The goal; its seed is that of the inner loop.
        config: Inner loop; 0 steps return the base policy.
        should_stop: Asked before every gradient step and every batch of the critic.
        on_step: See `adapt`.

    Raises:
        AdaptationCancelled: If `should_stop` returned true.
    """
    agent, trajectory_filter = deployment.agent, deployment.trajectory_filter
    if config.steps == 0:
        return Adaptation(agent, reason='adaptation is switched off (0 steps)')
    value_fn = agent.value_fn and _CancellableValue(agent.value_fn, should_stop)
    return adapt(
        agent,
        deployment.dataset,
        trajectory_filter.query(observation, goal.observation, value_fn),
        goal.observation,
        config,
        seed=goal.seed,
        should_stop=should_stop,
        on_step=on_step,
    )


def prefetch_values(deployment: Deployment, goal: Goal, should_stop: Callable[[], bool]) -> None:
    """Evaluate the critic towards `goal` on the whole dataset, which makes its next filter quick.

    Args:
        deployment: Policy and dataset; the policy has a critic.
        goal: The goal.
        should_stop: Asked before every batch of the critic.
    """
    value_fn = deployment.agent.value_fn
    assert value_fn is not None, 'policies without a critic have nothing to prefetch'
    cached = _CancellableValue(value_fn, should_stop=lambda: False)
    deployment.trajectory_filter.prefetch_values(cached, goal.observation, should_stop)
