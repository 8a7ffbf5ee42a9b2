"""The main job: goals published on a topic make a robot filter, adapt and drive there."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TYPE_CHECKING

from metagcttt_core.config import Settings
from metagcttt_core.files import refuse_foreign
import numpy as np
from pydantic import Field, model_validator
from sim_bridge import make_simulator

from metagcttt_tools.common import demo_report
from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.results import markdown_table

if TYPE_CHECKING:
    from metagcttt_tools.graph.client import GoalOutcome

_DESCRIPTION = """Drive to five goals over ROS 2 with three policies: a point, an ant, or a robot.

Example: make demo, or metagcttt demo in a set-up checkout
Starts sim_bridge_node, goal_node and policy_node as separate processes, publishes the five
evaluation goals on `goal_pose` for each arm, prints a table and writes OUT/summary.json and
OUT/demo.png. With --robot ant an ant walks through the same maze, and --film shows it; with
--robot diffbot it is a robot with two wheels, which speaks standard messages alone, and
robot_bridge_node. With --view the goals are yours: the post-trained policy drives to where you
click in a browser, until Ctrl-C."""


class _Maze(NamedTuple):
    """A maze to drive: its simulator, its assets and the preset that packs them.

    `adaptation` are parameters of the policy node, those of the preset's test-time training.
    """

    environment: str
    assets: str
    preset: str
    adaptation: Mapping[str, Any] = {}


_MAZES = {
    'point': _Maze(
        'pointmaze-medium-v0', 'pointmaze-medium-navigate', 'pointmaze-medium-navigate-cpu'
    ),
    'ant': _Maze(
        'antmaze-medium-v0',
        'antmaze-medium-navigate',
        'antmaze-medium-navigate-saw',
        {'adapt_lr': 3e-5, 'actor_only': True},
    ),
}


class DemoSettings(Settings):
    """Settings of the program."""

    robot: Literal['point', 'ant', 'diffbot'] = Field(
        'point',
        description='the point or the ant in the medium maze, or the robot with two wheels in '
        'its room',
    )
    out: Path = Field(Path('out/demo'), description='folder for summary, picture and node logs')
    steps: int | None = Field(
        None,
        ge=1,
        description='test-time training steps K of the adapting arms; by default 10 for the '
        'point, 50 for ant and diffbot',
    )
    seed: int = Field(0, ge=0, description='random seed of starts, goals and adaptations')
    timeout_s: float = Field(120.0, gt=0, description='longest wait for one goal, seconds')
    film: Path | None = Field(None, description='also film the ant with each policy, a GIF')
    view: bool = Field(False, description='send the goals by hand, in the live view')

    @property
    def budget(self) -> int:
        """Test-time training steps K."""
        return self.steps or {'point': 10, 'ant': 50, 'diffbot': 50}[self.robot]

    @model_validator(mode='after')
    def _robot_can_be_shown(self) -> DemoSettings:
        if self.view and self.robot != 'point':
            raise ValueError(f'view shows the point maze, not {self.robot}')
        if self.film and self.robot != 'ant':
            raise ValueError(f'film shows the ant, not {self.robot}')
        if self.film and self.film.suffix != '.gif':
            raise ValueError(f'film must end in .gif, got {self.film.name}')
        return self


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(DemoSettings, _DESCRIPTION, 'demo', argv)
    from metagcttt.commander import NoAnswerError
    from sim_bridge.simulator import SimulatorError

    from metagcttt_tools.graph.process import NodeFailedError

    try:
        if settings.view:
            drive_by_hand(settings)
            return
        film = [settings.film] if settings.film else []
        refuse_foreign(settings.out / 'summary.json', settings.out / 'demo.png', *film)
        if settings.robot == 'diffbot':
            from metagcttt_tools import demo_robot

            demo_robot.run(
                settings.robot,
                steps=settings.budget,
                seed=settings.seed,
                timeout_s=settings.timeout_s,
                out=settings.out,
            )
            return
        maze = _MAZES[settings.robot]
        assets = demo_report.packed_assets(maze.assets, maze.preset)
        outcomes = run_arms(settings, maze, assets)
        report(settings, maze.environment, assets / 'dataset.npz', outcomes)
        if settings.film:
            from metagcttt_tools import demo_film

            demo_film.film(maze.environment, outcomes, settings.film)
            print(f'film: {settings.film}')
    except (
        NodeFailedError,
        NoAnswerError,
        SimulatorError,
        FileNotFoundError,
        FileExistsError,
    ) as error:
        fail(str(error))
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def run_arms(settings: DemoSettings, maze: _Maze, assets: Path) -> dict[str, list[GoalOutcome]]:
    """Outcome of each task's goal by arm, from three processes that talk over DDS."""
    from metagcttt_tools.graph.client import MazeClient
    from metagcttt_tools.graph.drive import drive_arms

    dataset = {'dataset': str(assets / 'dataset.npz')}
    return drive_arms(
        {
            arm: {
                **dataset,
                **maze.adaptation,
                'checkpoint': str(checkpoint),
                'adapt_steps': steps,
            }
            for arm, (checkpoint, steps) in demo_report.arms_of(assets, settings.budget).items()
        },
        [
            partial(
                MazeClient.drive,
                task_id=task.task_id,
                seed=settings.seed,
                timeout_s=settings.timeout_s,
            )
            for task in make_simulator(maze.environment).tasks
        ],
        logs=settings.out / 'logs',
        simulator={'environment': maze.environment},
        goal_node={'environment': maze.environment, **dataset},
    )


def drive_by_hand(settings: DemoSettings) -> None:
    """Run the post-trained policy in real time and show it until Ctrl-C ends the process."""
    from metagcttt_tools.graph.drive import check, own_domain
    from metagcttt_tools.graph.process import NodeProcess
    from metagcttt_tools.live.view import show

    print(f'starting simulator, goal node and policy (logs: {settings.out / "logs"})', flush=True)
    with own_domain(), ExitStack() as stack:
        nodes = [
            stack.enter_context(NodeProcess(name, given, settings.out / 'logs' / f'{name}.log'))
            for name, given in (
                ('sim_bridge_node', {'seed': settings.seed}),
                ('goal_node', {'seed': settings.seed}),
                ('policy_node', {'adapt_steps': settings.budget}),
            )
        ]
        show(out=settings.out, check=partial(check, nodes))


def report(
    settings: DemoSettings,
    environment: str,
    dataset: Path,
    outcomes: dict[str, list[GoalOutcome]],
) -> None:
    """Print the table; write the summary and the picture."""
    print(format_table(outcomes))
    goals = [outcome.goal for outcome in next(iter(outcomes.values()))]
    demo_report.write_report(
        settings.out,
        {'environment': environment, 'settings': settings.model_dump(mode='json')},
        outcomes,
        numbers,
        partial(demo_report.draw, make_simulator(environment).maze, dataset, goals, outcomes),
    )


def numbers(outcome: GoalOutcome) -> dict[str, Any]:
    """The figures of one goal."""
    adaptation = outcome.report
    return {
        'success': outcome.success,
        'steps': outcome.steps,
        'adaptation_ms': adaptation.filter_ms + adaptation.adapt_ms,
        'transitions': adaptation.transitions,
        'trajectories': adaptation.kept_trajectories,
    }


def format_table(outcomes: dict[str, list[GoalOutcome]]) -> str:
    """The arms side by side, as Markdown."""
    arms = {arm: [numbers(outcome) for outcome in results] for arm, results in outcomes.items()}
    return markdown_table(
        [
            {
                'arm': arm,
                'goals reached': f'{sum(goal["success"] for goal in goals)} of {len(goals)}',
                'steps by task': ', '.join(
                    str(goal['steps']) if goal['success'] else 'missed' for goal in goals
                ),
                'adaptation ms (median)': round(np.median([g['adaptation_ms'] for g in goals])),
                'transitions (median)': round(np.median([g['transitions'] for g in goals])),
            }
            for arm, goals in arms.items()
        ]
    )
