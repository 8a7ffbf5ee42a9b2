"""The demo of a robot with a contract: its process, bridge, goals and policy, on small assets."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, TYPE_CHECKING

from metagcttt_core.config.yaml_file import load_yaml
import numpy as np
from sim_bridge.maze_map import MazeMap

from metagcttt_tools.common import demo_report
from metagcttt_tools.common.results import markdown_table
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
    assets = demo_report.packed_assets(robot, robot)
    graph = GraphSettings(
        contract=_CONTRACTS / f'{robot}.yaml',
        dataset=assets / 'dataset.npz',
        tasks=assets / 'tasks.yaml',
        timeout_s=timeout_s,
    )
    outcomes = drive_robot(graph, demo_report.arms_of(assets, steps), out / 'logs', seed)
    print(format_table(outcomes))
    about: dict[str, Any] = {'robot': robot, 'settings': graph.model_dump(mode='json')}
    about['settings'] |= {'steps': steps, 'seed': seed}
    goals = [task.position for task in load_yaml(graph.tasks, RobotTasks).tasks]
    demo_report.write_report(
        out,
        about,
        outcomes,
        numbers,
        partial(demo_report.draw, _room(), graph.dataset, goals, outcomes),
    )


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


def _room() -> MazeMap:
    """The plan of the room."""
    from metagcttt_robots.room import lower_corner, obstacles, UNIT_M

    x, y = lower_corner()
    return MazeMap(obstacles(), UNIT_M, (x + UNIT_M / 2, y + UNIT_M / 2))
