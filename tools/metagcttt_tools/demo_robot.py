"""The demo of a robot with a contract: its process, bridge, goals and policy, on small assets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import assets_dir
from metagcttt_core.config.yaml_file import load_yaml
from metagcttt_core.files import write_json
import numpy as np
from sim_bridge.maze_map import MazeMap

from metagcttt_tools.common.results import markdown_table
from metagcttt_tools.common.session import provenance
from metagcttt_tools.evaluate_robot import drive_robot, GraphSettings, numbers, RobotTasks

if TYPE_CHECKING:
    from metagcttt_tools.graph.robot import RobotOutcome

_CONTRACTS = Path(__file__).parents[2] / 'config' / 'robots'


def run(robot: str, *, steps: int, seed: int, timeout_s: float, out: Path) -> None:
    """Drive each task's goal with each policy; print the table, write summary and picture.

    Args:
        robot: Name of its assets and of its contract.
        steps: Test-time training steps K of the adapting arms.
        seed: Of the adaptations.
        timeout_s: Longest wait for one goal, seconds.
        out: Folder for summary, picture and logs.

    Raises:
        FileNotFoundError: If the assets are missing.
        NodeFailedError: If a node ends; with its log.
        NoAnswerError: If a node does not answer in time; with all logs.
    """
    assets = assets_dir() / robot
    graph = GraphSettings(
        contract=_CONTRACTS / f'{robot}.yaml',
        dataset=assets / 'dataset.npz',
        tasks=assets / 'tasks.yaml',
        timeout_s=timeout_s,
    )
    arms = {
        'base policy': (assets / 'base', 0),
        f'base + TTT (K = {steps})': (assets / 'base', steps),
        f'meta + TTT (K = {steps})': (assets / 'meta', steps),
    }
    outcomes = drive_robot(graph, arms, out / 'logs', seed)
    summary = {
        'robot': robot,
        'settings': {**graph.model_dump(mode='json'), 'steps': steps, 'seed': seed},
        **provenance(),
        'arms': {
            arm: [{'task': task, **numbers(outcome)} for task, outcome in enumerate(results, 1)]
            for arm, results in outcomes.items()
        },
    }
    write_json(out / 'summary.json', summary)
    _draw(graph, outcomes, out / 'demo.png')
    print(format_table(outcomes))
    print(f'summary: {out / "summary.json"}\npicture: {out / "demo.png"}')


def format_table(arms: dict[str, list[RobotOutcome]]) -> str:
    """The arms side by side, as Markdown."""
    return markdown_table(
        [
            {
                'arm': arm,
                'goals reached': f'{sum(each.success for each in drives)} of {len(drives)}',
                'seconds by task': ', '.join(
                    f'{each.seconds:.1f}' if each.success else 'missed' for each in drives
                ),
                'adaptation ms (median)': round(
                    np.median([each.report.filter_ms + each.report.adapt_ms for each in drives])
                ),
                'transitions (median)': round(
                    np.median([each.report.transitions for each in drives])
                ),
                'deadlines missed': f'{sum(each.missed for each in drives)} of '
                f'{sum(each.steps for each in drives):,}',
            }
            for arm, drives in arms.items()
        ]
    )


def _draw(graph: GraphSettings, outcomes: dict[str, list[RobotOutcome]], path: Path) -> None:
    """One panel a task, over the plan of the room."""
    from metagcttt_robots.room import lower_corner, obstacles, UNIT_M

    from metagcttt_tools.common.plots import demo_picture, save

    x, y = lower_corner()
    room = MazeMap(obstacles(), UNIT_M, (x + UNIT_M / 2, y + UNIT_M / 2))
    dataset = TrajectoryDataset.load(graph.dataset)
    tasks = load_yaml(graph.tasks, RobotTasks).tasks
    last = list(outcomes.values())[-1]
    figure = demo_picture(
        room,
        paths={arm: [np.array(each.path) for each in drives] for arm, drives in outcomes.items()},
        successes={arm: [each.success for each in drives] for arm, drives in outcomes.items()},
        segments=[
            [
                dataset.observations[start:stop, :2]
                for start, stop in zip(
                    each.report.segment_starts, each.report.segment_stops, strict=True
                )
            ]
            for each in last
        ],
        goals=[task.position for task in tasks],
    )
    save(figure, path)
