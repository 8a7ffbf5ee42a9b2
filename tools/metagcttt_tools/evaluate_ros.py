"""Success of policies in the ROS graph, in the episodes of `metagcttt evaluate`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, TYPE_CHECKING

from metagcttt_core import FilterConfig
from metagcttt_core.adaptation import TTTSettings
from metagcttt_core.files import write_json
import numpy as np
from pydantic import Field, model_validator
from sim_bridge import make_simulator

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.environment import environment_of
from metagcttt_tools.common.session import provenance, sole_writer
from metagcttt_tools.common.sources import unchanged
from metagcttt_tools.evaluate import (
    EpisodeSettings,
    format_table,
    success_curve,
    success_point,
)

if TYPE_CHECKING:
    from metagcttt_tools.graph.client import GoalOutcome

_DESCRIPTION = """Success of policies by test-time training budget, driven through the ROS graph.

Example: metagcttt evaluate-ros --preset antmaze-medium-navigate-study
Simulator, goal node and policy node run as processes in lockstep, on the tasks and seeds of
metagcttt evaluate: the same settings reach the same goals. Prints a table, writes OUT as JSON."""


# Parameters of policy_node by the settings they stand for.
_TTT_PARAMETERS = {
    'lr': 'adapt_lr',
    'batch_size': 'adapt_batch_size',
    'early_stopping': 'early_stopping',
    'test_fraction': 'test_fraction',
    'guard': 'guard',
    'actor_only': 'actor_only',
    'optimizer_state': 'optimizer_state',
    'engine': 'engine',
    'precision': 'precision',
    'horizon': 'horizon',
}
_FILTER_PARAMETERS = {
    'variant': 'filter_variant',
    'epsilon': 'epsilon',
    'top_percent': 'top_percent',
}


class EvaluateRosSettings(EpisodeSettings):
    """Settings of the program."""

    checkpoints: tuple[Path, ...] = Field(
        (Path('out/pretrain/checkpoint'),), min_length=1, description='policies to evaluate'
    )
    timeout_s: float = Field(300.0, gt=0, description='longest wait for one goal, seconds')
    out: Path = Field(
        Path('out/evaluation-ros/evaluation.json'),
        description='file for the results; logs of the nodes go beside it',
    )

    @model_validator(mode='after')
    def _must_be_parameters(self) -> EvaluateRosSettings:
        """Refuse settings for which policy_node has no parameter."""
        ttt = self.ttt.model_dump(include=set(_TTT_PARAMETERS))
        filtering = self.filter.model_dump(include=set(_FILTER_PARAMETERS))
        for name, given, possible in (
            ('ttt', self.ttt, TTTSettings(**ttt)),
            ('filter', self.filter, FilterConfig(**filtering)),
        ):
            default = possible.model_dump()
            for field, value in given.model_dump().items():
                if value != default[field]:
                    raise ValueError(
                        f'{name}.{field}: policy_node has no such parameter and takes '
                        f'{default[field]!r}, got {value!r}'
                    )
        return self


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(EvaluateRosSettings, _DESCRIPTION, 'evaluate-ros', argv, section='evaluate')
    from metagcttt.commander import NoAnswerError

    from metagcttt_tools.graph.process import NodeFailedError

    try:
        with sole_writer(settings.out, settings.out):
            with unchanged(settings.dataset, settings.checkpoints) as known:
                results = evaluate_ros(settings)
            report = {'settings': settings.model_dump(mode='json'), **provenance(), **known}
            write_json(settings.out, {**report, 'results': results})
    except (NodeFailedError, NoAnswerError, ValueError) as error:
        fail(str(error))
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    print(format_table(results, settings.standing))
    print('median adaptation, filter and inner loop (ms):')
    for result in results:
        times = ', '.join(
            f'K = {point["budget"]}: {point["filter_ms"]:.0f} + {point["adapt_ms"]:.0f}'
            for point in result['curve']
        )
        print(f'  {result["checkpoint"]}: {times}')
    print(f'results: {settings.out}')


def evaluate_ros(settings: EvaluateRosSettings) -> list[dict[str, Any]]:
    """Success by policy and budget, as `metagcttt evaluate` has it, with the times of adaptations.

    Raises:
        ValueError: If checkpoints are damaged or for different environments.
        NodeFailedError: If a node ends; with its log.
        NoAnswerError: If a node does not answer in time.
    """
    from metagcttt_core import load_checkpoint
    from metagcttt_core.evaluation.rollout import episode_seed

    from metagcttt_tools.graph.client import MazeClient
    from metagcttt_tools.graph.drive import drive_arms

    environments = {environment_of(load_checkpoint(path)) for path in settings.checkpoints}
    if len(environments) > 1:
        raise ValueError(f'checkpoints for one environment at a time, got {sorted(environments)}')
    environment = environments.pop()
    with make_simulator(environment, standing=settings.standing) as simulator:
        tasks = [task.task_id for task in simulator.tasks]
    episodes = [
        (seed, task, number)
        for seed in settings.seeds
        for task in tasks
        for number in range(settings.episodes)
    ]
    world = {'environment': environment}
    outcomes = drive_arms(
        {
            (path, budget): _parameters(settings, path, budget)
            for path in settings.checkpoints
            for budget in settings.budgets
        },
        [
            partial(
                MazeClient.drive,
                task_id=task,
                seed=episode_seed(seed, task, number),
                timeout_s=settings.timeout_s,
                as_task=True,
            )
            for seed, task, number in episodes
        ],
        logs=settings.out.parent / 'logs',
        simulator={**world, 'standing': settings.standing},
        goal_node={**world, 'dataset': str(settings.dataset)},
    )
    return [
        success_curve(
            path,
            [
                _point(settings, tasks, budget, outcomes[path, budget])
                for budget in settings.budgets
            ],
        )
        for path in settings.checkpoints
    ]


def _parameters(
    settings: EvaluateRosSettings, checkpoint: Path, budget: int
) -> dict[str, bool | int | float | str]:
    """Parameters of policy_node."""
    chosen = {name: getattr(settings.ttt, field) for field, name in _TTT_PARAMETERS.items()}
    chosen |= {name: getattr(settings.filter, field) for field, name in _FILTER_PARAMETERS.items()}
    chosen['horizon'] = chosen['horizon'] or 0
    files = {'checkpoint': str(checkpoint), 'dataset': str(settings.dataset)}
    return {**files, **chosen, 'adapt_steps': budget, 'threads': 1}


def _point(
    settings: EvaluateRosSettings, tasks: list[int], budget: int, outcomes: list[GoalOutcome]
) -> dict[str, Any]:
    """One budget of one policy; outcomes are in the order of seeds, tasks and episodes."""
    shape = (len(settings.seeds), len(tasks), settings.episodes)
    rates = np.reshape([outcome.success for outcome in outcomes], shape).mean(axis=2)
    reports = [outcome.report for outcome in outcomes]
    return {
        **success_point(budget, dict(zip(tasks, rates.T.tolist(), strict=True))),
        'filter_ms': float(np.median([report.filter_ms for report in reports])),
        'adapt_ms': float(np.median([report.adapt_ms for report in reports])),
    }
