"""Episodes of a policy that adapts, in a simulator (OGBench's protocol)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from metagcttt_core.adaptation.adapt import adapt
from metagcttt_core.adaptation.config import TTTConfig
from metagcttt_core.adaptation.result import Adaptation
from metagcttt_core.agents.agent import Agent
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.retrieval.support import SupportSet
from metagcttt_core.retrieval.trajectory_filter import TrajectoryFilter


class Simulator(Protocol):
    """The part of a simulator that an evaluation uses."""

    @property
    def tasks(self) -> Iterable[Any]:
        """The evaluation tasks, each with a `task_id`."""

    def reset(self, task_id: int | None = None, seed: int | None = None) -> tuple[Any, Any]:
        """Start an episode; returns the observation and the goal."""

    def step(self, action: np.ndarray) -> Any:
        """Apply an action; the result has `observation`, `terminated`, `truncated`, `success`."""


@dataclass(frozen=True)
class Episode:
    """One episode.

    Attributes:
        task_id: The evaluation task.
        success: True if the goal was reached within the limit.
        observations: (T + 1, obs_dim) float64, from the first to the last.
        actions: (T, act_dim) float32.
        supports: The filtered dataset of each adaptation.
        adaptations: Each adaptation, in order.
    """

    task_id: int
    success: bool
    observations: np.ndarray
    actions: np.ndarray
    supports: list[SupportSet]
    adaptations: list[Adaptation]

    @property
    def steps(self) -> int:
        """Number of control steps T."""
        return len(self.actions)


def run_episode(
    agent: Agent,
    simulator: Simulator,
    task_id: int,
    seed: int,
    *,
    trajectory_filter: TrajectoryFilter | None = None,
    ttt: TTTConfig | None = None,
) -> Episode:
    """One episode of an evaluation task: filter, adapt, act.

    Args:
        agent: The base policy.
        simulator: The simulator to act in.
        task_id: The evaluation task.
        seed: Of the simulator's reset and of the adaptation.
        trajectory_filter: Where support sets come from; needed to adapt.
        ttt: Test-time training; by default the base policy acts as it is. With `horizon`, the base
            weights are adapted again to the current state every that many steps.
    """
    ttt = ttt or TTTConfig(steps=0)
    if ttt.steps > 0 and trajectory_filter is None:
        raise ValueError('test-time training needs a dataset or a trajectory filter')
    if trajectory_filter is not None:
        agent.check(trajectory_filter.dataset)
    observation, goal = simulator.reset(task_id=task_id, seed=seed)
    observations: list[np.ndarray] = [observation]
    actions: list[np.ndarray] = []
    supports: list[SupportSet] = []
    adaptations: list[Adaptation] = []
    expert = agent
    finished = False
    while not finished:
        if trajectory_filter is not None and _adaptation_is_due(ttt, step=len(actions)):
            supports.append(trajectory_filter.query(observation, goal, agent.value_fn))
            adaptations.append(
                adapt(agent, trajectory_filter.dataset, supports[-1], goal, ttt, seed=seed)
            )
            expert = adaptations[-1].agent
        action = expert.act(observation, goal)
        result = simulator.step(action)
        observation = result.observation
        observations.append(observation)
        actions.append(action)
        finished = result.terminated or result.truncated
    return Episode(
        task_id=task_id,
        success=bool(result.success),
        observations=np.array(observations),
        actions=np.array(actions),
        supports=supports,
        adaptations=adaptations,
    )


def _adaptation_is_due(ttt: TTTConfig, step: int) -> bool:
    if ttt.steps == 0:
        return False
    return step % ttt.horizon == 0 if ttt.horizon else step == 0


def evaluate_success(
    agent: Agent,
    simulator: Simulator,
    dataset: TrajectoryDataset | None = None,
    ttt: TTTConfig | None = None,
    episodes: int = 50,
    tasks: Iterable[int] | None = None,
    seed: int = 0,
    *,
    trajectory_filter: TrajectoryFilter | None = None,
) -> dict[str, Any]:
    """Success rates by OGBench's protocol: deterministic actions on every evaluation task.

    Args:
        agent: The base policy.
        simulator: The simulator to act in.
        dataset: The dataset to adapt on, filtered with the default settings.
        ttt: Test-time training; none by default.
        episodes: Episodes per task.
        tasks: Task numbers; all by default.
        seed: Random seed of the evaluation, from which every episode derives its own.
        trajectory_filter: A filter to use instead of one made from `dataset`.

    Returns:
        `tasks` (success rate by task number), `mean` (over tasks), `steps` (mean control steps
        of the successful episodes by task number, None without any) and `accepted` (share of the
        adaptations whose expert was accepted, None without any).
    """
    if episodes < 1:
        raise ValueError(f'episodes must be at least 1, got {episodes}')
    task_ids = [task.task_id for task in simulator.tasks] if tasks is None else list(tasks)
    if not task_ids:
        raise ValueError('tasks must hold at least one task number, got none')
    if trajectory_filter is None and dataset is not None and ttt is not None and ttt.steps > 0:
        trajectory_filter = TrajectoryFilter(dataset)
    rates: dict[int, float] = {}
    steps: dict[int, float | None] = {}
    accepted: list[bool] = []
    for task_id in task_ids:
        results = [
            run_episode(
                agent,
                simulator,
                task_id,
                episode_seed(seed, task_id, number),
                trajectory_filter=trajectory_filter,
                ttt=ttt,
            )
            for number in range(episodes)
        ]
        rates[task_id] = float(np.mean([episode.success for episode in results]))
        reached = [episode.steps for episode in results if episode.success]
        steps[task_id] = float(np.mean(reached)) if reached else None
        accepted += [each.accepted for episode in results for each in episode.adaptations]
    return {
        'tasks': rates,
        'mean': float(np.mean(list(rates.values()))),
        'steps': steps,
        'accepted': float(np.mean(accepted)) if accepted else None,
    }


def episode_seed(seed: int, task_id: int, number: int) -> int:
    """The seed of one episode of an evaluation, below 2**31."""
    return int(np.random.SeedSequence((seed, task_id, number)).generate_state(1)[0] >> 1)
