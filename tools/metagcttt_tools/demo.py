"""The main job: goals published on a topic make a robot filter, adapt and drive there."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Literal, TYPE_CHECKING

from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import assets_dir, Settings
from metagcttt_core.files import refuse_foreign, write_json
import numpy as np
from pydantic import Field, model_validator
from sim_bridge import make_simulator

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.results import markdown_table
from metagcttt_tools.common.session import provenance

if TYPE_CHECKING:
    from metagcttt_tools.graph.client import GoalOutcome

_DESCRIPTION = """Drive to five goals over ROS 2 with three policies: the point maze, or a robot.

Example: make demo, or metagcttt demo in a set-up checkout
Starts sim_bridge_node, goal_node and policy_node as separate processes, publishes the five
evaluation goals on `goal_pose` for each arm, prints a table and writes OUT/summary.json and
OUT/demo.png. With --robot diffbot it is a robot with two wheels, which speaks standard messages
alone, and robot_bridge_node. With --view the goals are yours: the post-trained policy drives to
where you click in a browser, until Ctrl-C."""

_ENVIRONMENT = 'pointmaze-medium-v0'
_ASSETS = 'pointmaze-medium-navigate'


class DemoSettings(Settings):
    """Settings of the program."""

    robot: Literal['point', 'diffbot'] = Field(
        'point', description='the point maze, or the robot with two wheels in its room'
    )
    out: Path = Field(Path('out/demo'), description='folder for summary, picture and node logs')
    steps: int | None = Field(
        None,
        ge=1,
        description='test-time training steps K of the adapting arms; by default 10, and 50 for '
        'the diffbot',
    )
    seed: int = Field(0, ge=0, description='random seed of starts, goals and adaptations')
    timeout_s: float = Field(60.0, gt=0, description='longest wait for one goal, seconds')
    view: bool = Field(False, description='send the goals by hand, in the live view')

    @property
    def budget(self) -> int:
        """Test-time training steps K."""
        return self.steps or {'point': 10, 'diffbot': 50}[self.robot]

    @model_validator(mode='after')
    def _the_view_is_of_the_maze(self) -> DemoSettings:
        if self.view and self.robot != 'point':
            raise ValueError(f'view shows the point maze, not {self.robot}')
        return self


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(DemoSettings, _DESCRIPTION, 'demo', argv)
    from metagcttt.commander import NoAnswerError

    from metagcttt_tools.graph.process import NodeFailedError

    try:
        if settings.view:
            drive_by_hand(settings)
            return
        refuse_foreign(settings.out / 'summary.json', settings.out / 'demo.png')
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
        outcomes = run_arms(settings)
    except (NodeFailedError, NoAnswerError, FileNotFoundError, FileExistsError) as error:
        fail(str(error))
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    report(settings, outcomes)


def run_arms(settings: DemoSettings) -> dict[str, list[GoalOutcome]]:
    """Outcome of each task's goal by arm, from three processes that talk over DDS."""
    from metagcttt_tools.graph.client import MazeClient
    from metagcttt_tools.graph.drive import drive_arms

    arms = {
        'base policy': ('base', 0),
        f'base + TTT (K = {settings.budget})': ('base', settings.budget),
        f'meta + TTT (K = {settings.budget})': ('meta', settings.budget),
    }
    return drive_arms(
        {
            arm: {'checkpoint': str(assets_dir() / _ASSETS / checkpoint), 'adapt_steps': steps}
            for arm, (checkpoint, steps) in arms.items()
        },
        [
            partial(
                MazeClient.drive,
                task_id=task.task_id,
                seed=settings.seed,
                timeout_s=settings.timeout_s,
            )
            for task in make_simulator(_ENVIRONMENT).tasks
        ],
        logs=settings.out / 'logs',
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


def report(settings: DemoSettings, outcomes: dict[str, list[GoalOutcome]]) -> None:
    """Print the table; write the summary and the picture."""
    from metagcttt_tools.common.plots import demo_picture, save

    summary = {
        'environment': _ENVIRONMENT,
        'settings': settings.model_dump(mode='json'),
        **provenance(),
        'arms': {
            arm: [{'task': task, **numbers(outcome)} for task, outcome in enumerate(results, 1)]
            for arm, results in outcomes.items()
        },
    }
    write_json(settings.out / 'summary.json', summary)
    dataset = TrajectoryDataset.load(assets_dir() / _ASSETS / 'dataset.npz')
    simulator = make_simulator(_ENVIRONMENT)
    last = list(outcomes.values())[-1]
    figure = demo_picture(
        simulator.maze,
        paths={arm: [np.array(o.path) for o in results] for arm, results in outcomes.items()},
        successes={arm: [o.success for o in results] for arm, results in outcomes.items()},
        segments=[
            [
                dataset.observations[start:stop, :2]
                for start, stop in zip(
                    o.report.segment_starts, o.report.segment_stops, strict=True
                )
            ]
            for o in last
        ],
        goals=[outcome.goal for outcome in last],
    )
    save(figure, settings.out / 'demo.png')
    print(format_table(summary['arms']))
    print(f'summary: {settings.out / "summary.json"}\npicture: {settings.out / "demo.png"}')


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


def format_table(arms: dict[str, list[dict[str, Any]]]) -> str:
    """The arms side by side, as Markdown."""
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
