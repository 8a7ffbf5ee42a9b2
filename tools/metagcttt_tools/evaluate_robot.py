"""Success of policies on a simulated robot, driven by its contract through the ROS graph."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TYPE_CHECKING, TypeVar

from metagcttt_core import success_statistics
from metagcttt_core.config import Settings
from metagcttt_core.config.yaml_file import load_yaml
from metagcttt_core.files import write_json
from metagcttt_core.robot import Contract, load_contract
import numpy as np
from pydantic import Field, model_validator

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.results import markdown_table
from metagcttt_tools.common.session import provenance, sole_writer
from metagcttt_tools.common.sources import unchanged

if TYPE_CHECKING:
    from metagcttt_tools.graph.robot import RobotOutcome

_DESCRIPTION = """Success of policies on a simulated robot, by test-time training budget.

Example: metagcttt evaluate-robot --checkpoints out/diffbot/checkpoint --dataset data/diffbot.npz
Starts the robot of metagcttt_robots that the contract is for, robot_bridge_node, goal_node and
policy_node as processes and sends the goals of TASKS. With {seed} in a checkpoint's name there is
one policy a seed. Prints a table with standard errors over seeds and writes OUT as JSON."""

ROBOTS = {'diffbot': 'diffbot', 'arm4': 'arm'}
"""Executables of metagcttt_robots by the robot that a contract names."""

_SEED = '{seed}'
ArmT = TypeVar('ArmT')
Finite = Annotated[float, Field(allow_inf_nan=False)]


class RobotTask(Settings):
    """A start and a goal."""

    start: tuple[Finite, Finite, Finite] | None = Field(
        None, description='x, y in metres and yaw in radians; by default where the robot is'
    )
    goal: tuple[Finite, Finite] | dict[str, Finite] = Field(
        description='x, y in metres, or values by the names of the contract'
    )

    @property
    def position(self) -> tuple[float, float]:
        """The goal of a robot with a position, metres.

        Raises:
            ValueError: If it is one by named values.
        """
        if isinstance(self.goal, dict):
            raise ValueError(f'the goal {self.goal} is no position')
        return self.goal


class RobotTasks(Settings):
    """Tasks of a robot, as a YAML file has them."""

    tasks: tuple[RobotTask, ...] = Field(min_length=1, description='in their order')
    max_s: float = Field(gt=0, description='simulated seconds that a goal may take')


class GraphSettings(Settings):
    """Settings of the drives."""

    contract: Path = Field(
        Path('config/robots/diffbot.yaml'), description="the robot's contract (YAML)"
    )
    dataset: Path = Field(Path('data/diffbot.npz'), description='dataset to adapt on (npz)')
    tasks: Path = Field(Path('assets/diffbot/tasks.yaml'), description='starts and goals (YAML)')
    lr: float = Field(3e-4, gt=0, description='learning rate of the adaptation')
    batch_size: int = Field(256, ge=1, description='transitions per gradient step')
    speed_factor: float = Field(
        0.0,
        ge=0,
        le=100,
        description='simulated seconds per second; 0: as fast as commands come',
    )
    timeout_s: float = Field(120.0, gt=0, description='longest wait for one goal, seconds')


class EvaluateRobotSettings(GraphSettings):
    """Settings of the program."""

    checkpoints: tuple[str, ...] = Field(
        ('out/diffbot/checkpoint',),
        min_length=1,
        description='policies to evaluate; {seed} stands for each of the seeds',
    )
    budgets: tuple[int, ...] = Field(
        (0, 20), min_length=1, description='numbers of gradient steps K'
    )
    seeds: tuple[int, ...] = Field((0,), min_length=1, description='of the policies')
    out: Path = Field(
        Path('out/evaluation-robot/evaluation.json'),
        description='file for the results; logs of the nodes go beside it',
    )

    @model_validator(mode='after')
    def _a_policy_a_seed(self) -> EvaluateRobotSettings:
        """Refuse to count one policy as several."""
        for checkpoint in self.checkpoints:
            if len(self.seeds) > 1 and _SEED not in checkpoint:
                raise ValueError(f'{checkpoint} must name the {_SEED}: there are several')
        return self


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(EvaluateRobotSettings, _DESCRIPTION, 'evaluate-robot', argv)
    from metagcttt.commander import NoAnswerError

    from metagcttt_tools.graph.process import NodeFailedError

    arms = {
        (checkpoint, budget, seed): (Path(checkpoint.replace(_SEED, str(seed))), budget)
        for checkpoint in settings.checkpoints
        for budget in settings.budgets
        for seed in settings.seeds
    }
    policies = sorted({path for path, _ in arms.values()})
    try:
        robot_of(settings)  # before anything is written
        with sole_writer(settings.out, settings.out):
            with unchanged(settings.dataset, policies) as known:
                outcomes = drive_robot(settings, arms, settings.out.parent / 'logs')
            results = _results(settings, outcomes)
            report = {'settings': settings.model_dump(mode='json'), **provenance(), **known}
            write_json(settings.out, {**report, 'results': results})
    except (NodeFailedError, NoAnswerError, ValueError, FileExistsError) as error:
        fail(*str(error).splitlines())
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    print(format_table(results))
    print(f'results: {settings.out}')


def _results(
    settings: EvaluateRobotSettings,
    outcomes: Mapping[tuple[str, int, int], list[RobotOutcome]],
) -> list[dict[str, Any]]:
    return [
        {
            'checkpoint': checkpoint,
            'budget': budget,
            'seeds': {
                seed: [numbers(outcome) for outcome in outcomes[checkpoint, budget, seed]]
                for seed in settings.seeds
            },
        }
        for checkpoint in settings.checkpoints
        for budget in settings.budgets
    ]


def robot_of(settings: GraphSettings) -> tuple[Contract, RobotTasks]:
    """The contract of a simulated robot, and its tasks.

    Raises:
        ValueError: If one is wrong, or the robot is none that is simulated.
    """
    contract = load_contract(settings.contract)
    if contract.robot not in ROBOTS:
        raise ValueError(
            f'{settings.contract}: {contract.robot} is not simulated, {", ".join(ROBOTS)} are'
        )
    return contract, load_yaml(settings.tasks, RobotTasks)


def drive_robot(
    settings: GraphSettings, arms: Mapping[ArmT, tuple[Path, int]], logs: Path, seed: int = 0
) -> dict[ArmT, list[RobotOutcome]]:
    """Outcome of each task by arm, from five processes that talk over DDS.

    Args:
        settings: The robot, its data and its tasks.
        arms: Checkpoint and number of gradient steps by arm.
        logs: Folder for what the nodes print.
        seed: Of the adaptations.

    Raises:
        ValueError: If contract or tasks are wrong, or the robot is none that is simulated.
        NodeFailedError: If a node ends; with its log.
        NoAnswerError: If a node does not answer in time; with all logs.
    """
    from metagcttt_tools.graph.drive import drive_policies, Executable
    from metagcttt_tools.graph.robot import RobotClient

    contract, tasks = robot_of(settings)
    clock = {'use_sim_time': True}
    files = {'contract': str(settings.contract)}
    dataset = {'dataset': str(settings.dataset)}
    policy: dict[str, str | int | float] = {
        'adaptation': 'hold',  # the robot's time may pass much faster than that of the policy
        'adapt_lr': settings.lr,
        'adapt_batch_size': settings.batch_size,
        'diagnostics_period_s': 0.2,
    }
    return drive_policies(
        [
            Executable(
                ROBOTS[contract.robot], {'speed_factor': settings.speed_factor}, 'metagcttt_robots'
            ),
            Executable('robot_bridge_node', {**clock, **files}),
            Executable('goal_node', {**clock, **files, **dataset, 'seed': seed}),
        ],
        {
            arm: {
                **clock,
                **dataset,
                **policy,
                'checkpoint': str(checkpoint),
                'adapt_steps': budget,
            }
            for arm, (checkpoint, budget) in arms.items()
        },
        [
            partial(
                RobotClient.drive,
                goal=task.goal,
                start=task.start,
                max_s=tasks.max_s,
                timeout_s=settings.timeout_s,
            )
            for task in tasks.tasks
        ],
        partial(RobotClient, contract=contract),
        logs,
    )


def numbers(outcome: RobotOutcome) -> dict[str, Any]:
    """The figures of one goal."""
    adaptation = outcome.report
    return {
        'success': outcome.success,
        'seconds': outcome.seconds,
        'steps': outcome.steps,
        'missed_deadlines': outcome.missed,
        'adaptation_ms': adaptation.filter_ms + adaptation.adapt_ms,
        'transitions': adaptation.transitions,
    }


def format_table(results: list[dict[str, Any]]) -> str:
    """Success, times and deadlines by policy and budget, as Markdown."""
    rows = []
    for result in results:
        drives = [goal for goals in result['seeds'].values() for goal in goals]
        rates = [np.mean([g['success'] for g in goals]) for goals in result['seeds'].values()]
        success = success_statistics(rates)
        reached = [goal['seconds'] for goal in drives if goal['success']]
        rows.append(
            {
                'policy': result['checkpoint'],
                'K': result['budget'],
                'goals reached': f'{success.mean:.2f} ± {success.standard_error:.2f}',
                'seconds (median)': f'{np.median(reached):.1f}' if reached else '',
                'adaptation ms (median)': round(np.median([g['adaptation_ms'] for g in drives])),
                'deadlines missed': f'{sum(g["missed_deadlines"] for g in drives)} of '
                f'{sum(g["steps"] for g in drives):,}',
            }
        )
    return markdown_table(rows)
