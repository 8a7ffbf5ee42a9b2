"""How near an adapted policy is to held-out trajectories: an evaluation without a simulator."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
import torch

from metagcttt_core.adaptation.adapt import adapt
from metagcttt_core.adaptation.config import TTTSettings
from metagcttt_core.agents.agent import Agent
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.errors import DatasetError
from metagcttt_core.retrieval.trajectory_filter import TrajectoryFilter


class Query(NamedTuple):
    """A state of a held-out trajectory, with a later one of it as the goal.

    Attributes:
        row: The row of the state.
        steps: The goal is the state so many rows later.
    """

    row: int
    steps: int


@dataclass(frozen=True)
class Outcome:
    """What became of one query.

    Attributes:
        trajectory: The held-out trajectory.
        steps: Rows to the goal.
        distance: From the state to the goal, in units of the position.
        support: Transitions that the filter found.
        errors: By budget K, the mean squared error of the actions on the way to the goal.
        log_likelihoods: By budget K, the mean log-density of the recorded actions there.
    """

    trajectory: int
    steps: int
    distance: float
    support: int
    errors: Mapping[int, float]
    log_likelihoods: Mapping[int, float]


class Interval(NamedTuple):
    """A mean with its 95 percent interval."""

    mean: float
    low: float
    high: float


def hold_out(
    dataset: TrajectoryDataset, share: float, seed: int
) -> tuple[TrajectoryDataset, TrajectoryDataset]:
    """The dataset without some of its trajectories, drawn at random, and those.

    Raises:
        DatasetError: If not at least one trajectory is left on either side.
    """
    count = round(share * dataset.num_episodes)
    if not 0 < count < dataset.num_episodes:
        raise DatasetError(
            f'{dataset.source or "dataset"}: {share:g} of {dataset.num_episodes} trajectories '
            'leaves none on one side'
        )
    held = np.zeros(dataset.num_episodes, bool)
    held[np.random.default_rng(seed).permutation(dataset.num_episodes)[:count]] = True
    rows = held[dataset.episode_of(np.arange(dataset.num_rows))]
    kept, out = (
        TrajectoryDataset.from_arrays(
            dataset.states(part),
            dataset.actions[part],
            dataset.terminals[part],
            source=dataset.source,
            contract=dataset.contract,
        )
        for part in (~rows, rows)
    )
    return kept, out


def draw_queries(
    held_out: TrajectoryDataset, steps: Sequence[int], per_trajectory: int, most: int, seed: int
) -> list[Query]:
    """Queries from held-out trajectories, equally many for each number of steps to the goal.

    Args:
        held_out: The trajectories.
        steps: Rows from state to goal; trajectories that are too short for one have no such query.
        per_trajectory: Queries for each of `steps` in a trajectory.
        most: Trajectories to take, drawn at random.
        seed: Random seed.

    Raises:
        DatasetError: If no trajectory is long enough for any of `steps`.
    """
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.permutation(held_out.num_episodes)[:most])
    queries = []
    for trajectory in chosen:
        start, end = held_out.episode_starts[trajectory], held_out.episode_ends[trajectory]
        for ahead in steps:
            if end - ahead >= start:
                rows = rng.integers(start, end - ahead + 1, size=per_trajectory)
                queries += [Query(int(row), ahead) for row in rows]
    if not queries:
        longest = int((held_out.episode_ends - held_out.episode_starts).max())
        raise DatasetError(
            f'{held_out.source or "dataset"}: the longest held-out trajectory has {longest} '
            f'transitions, fewer than {min(steps)}'
        )
    return queries


def evaluate_query(
    agent: Agent,
    trajectory_filter: TrajectoryFilter,
    held_out: TrajectoryDataset,
    query: Query,
    ttt: TTTSettings,
    budgets: Sequence[int],
    seed: int = 0,
) -> Outcome:
    """Adapt to a query as a deployed policy does, and compare actions along the recorded way.

    Args:
        agent: The base policy.
        trajectory_filter: Where support sets come from; does not hold the held-out trajectories.
        held_out: The dataset of the query.
        query: The state and the goal.
        ttt: Test-time training.
        budgets: Numbers of gradient steps K. Where nothing is retrieved the base policy answers.
        seed: Of the adaptation.
    """
    rows = np.arange(query.row, query.row + query.steps)
    state, goal = held_out.states(query.row), held_out.states(int(rows[-1]) + 1)
    support = trajectory_filter.query(state, goal, agent.value_fn)
    dims = list(trajectory_filter.config.position_dims)
    errors, log_likelihoods = {}, {}
    for budget in budgets:
        expert = adapt(
            agent, trajectory_filter.dataset, support, goal, ttt.with_steps(budget), seed=seed
        ).agent
        errors[budget], log_likelihoods[budget] = _compare(expert, held_out, rows, goal)
    return Outcome(
        trajectory=int(held_out.episode_of(np.array(query.row))),
        steps=query.steps,
        distance=float(np.linalg.norm(state[dims] - goal[dims])),
        support=len(support),
        errors=errors,
        log_likelihoods=log_likelihoods,
    )


def _compare(
    agent: Agent, held_out: TrajectoryDataset, rows: NDArray[np.int64], goal: np.ndarray
) -> tuple[float, float]:
    """Mean squared error per value of an action, and mean log-density of the recorded actions."""
    observations, actions = held_out.states(rows), np.asarray(held_out.actions[rows])
    error = float(np.square(agent.act(observations, goal) - actions).mean())
    scaling = agent.scaling
    batch = agent.tensors(
        {
            'observations': scaling.observations(observations),
            'goals': scaling.observations(np.broadcast_to(goal, observations.shape)),
            'actions': scaling.actions(actions),
        }
    )
    with torch.inference_mode():
        log_prob, _ = agent.log_prob(batch['observations'], batch['goals'], batch['actions'])
    return error, float(log_prob.mean()) - float(np.log(scaling.limit).sum())


def bootstrap(
    values: NDArray[np.float64], trajectories: NDArray[np.int64], seed: int = 0, draws: int = 2000
) -> NDArray[np.float64]:
    """Means of resampled trajectories, (draws + 1, ...); the first is that of all values.

    Args:
        values: (n, ...) values of queries.
        trajectories: (n,) the trajectory of each; those of one are not independent.
        seed: Random seed; equal ones draw the same trajectories.
        draws: Number of resamples.
    """
    _, groups = np.unique(trajectories, return_inverse=True)
    count = int(groups.max()) + 1
    sums = np.zeros((count, *values.shape[1:]))
    np.add.at(sums, groups, values)
    sizes = np.bincount(groups).astype(np.float64)
    times = np.random.default_rng(seed).multinomial(count, [1 / count] * count, size=draws)
    times = np.vstack([np.ones(count), times])
    shape = (-1, *[1] * (values.ndim - 1))
    return np.tensordot(times, sums, axes=1) / (times @ sizes).reshape(shape)


def interval(draws: NDArray[np.float64]) -> Interval:
    """The mean and the 95 percent interval of what `bootstrap` returns, or of a function of it."""
    low, high = np.percentile(draws[1:], (2.5, 97.5))
    return Interval(float(draws[0]), float(low), float(high))
