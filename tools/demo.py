"""The main job: goals published on a topic make a robot filter, adapt and drive there."""

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from functools import partial
import json
import os
from pathlib import Path
from typing import Any

from domain_coordinator import domain_id
from metagcttt.commander import NoAnswerError
from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import assets_dir, Settings
from metagcttt_core.files import atomic_write
import numpy as np
from pydantic import Field
import rclpy
from sim_bridge import make_simulator
from tqdm import tqdm

from tools.cli import fail, parse
from tools.maze_client import GoalOutcome, MazeClient
from tools.node_process import NodeFailedError, NodeProcess
from tools.plots import demo_picture, save
from tools.runs import provenance

_DESCRIPTION = """Drive the point maze over ROS 2: three policies, five goals.

Example: make demo, or python -m tools.demo in a set-up checkout
Starts sim_bridge_node, goal_node and policy_node as separate processes, publishes the five
evaluation goals on `goal_pose` for each arm, prints a table and writes OUT/summary.json and
OUT/demo.png."""

_ENVIRONMENT = 'pointmaze-medium-v0'
_ASSETS = 'pointmaze-medium-navigate'
START_TIMEOUT_S = 30.0


class DemoSettings(Settings):
    """Settings of the tool."""

    out: Path = Field(Path('out/demo'), description='folder for summary, picture and node logs')
    steps: int = Field(10, ge=1, description='test-time training steps K of the adapting arms')
    seed: int = Field(0, ge=0, description='of starts, goals and adaptations')
    timeout_s: float = Field(60.0, gt=0, description='longest wait for one goal, seconds')


def main(argv: list[str] | None = None) -> None:
    """Run the tool."""
    settings = parse(DemoSettings, _DESCRIPTION, 'demo', argv)
    try:
        outcomes = run_arms(settings)
    except (NodeFailedError, NoAnswerError, FileNotFoundError) as error:
        fail(str(error))
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    report(settings, outcomes)


def run_arms(settings: DemoSettings) -> dict[str, list[GoalOutcome]]:
    """Outcome of each task's goal by arm, from three processes that talk over DDS."""
    arms = {
        'base policy': ('base', 0),
        f'base + TTT (K = {settings.steps})': ('base', settings.steps),
        f'meta + TTT (K = {settings.steps})': ('meta', settings.steps),
    }
    num_tasks = len(make_simulator(_ENVIRONMENT).tasks)
    outcomes: dict[str, list[GoalOutcome]] = {}
    with ExitStack() as stack:
        stack.enter_context(own_domain())
        logs = settings.out / 'logs'
        nodes = [
            NodeProcess('sim_bridge_node', {'stepping': 'lockstep'}, logs / 'sim_bridge_node.log'),
            NodeProcess('goal_node', {'stepping': 'lockstep'}, logs / 'goal_node.log'),
        ]
        for node in nodes:
            stack.enter_context(node)
        rclpy.init()
        stack.callback(rclpy.try_shutdown)
        bar = stack.enter_context(tqdm(total=len(arms) * num_tasks, unit='goal', desc='demo'))
        for number, (arm, (checkpoint, steps)) in enumerate(arms.items()):
            parameters: dict[str, bool | int | float | str] = {
                'checkpoint': str(assets_dir() / _ASSETS / checkpoint),
                'adapt_steps': steps,
                'stepping': 'lockstep',
                'adaptation': 'hold',
            }
            log = logs / f'policy_node_{number}.log'
            with NodeProcess('policy_node', parameters, log) as policy:
                running = [*nodes, policy]
                client = MazeClient(partial(check, running))
                try:
                    client.wait_until_ready(START_TIMEOUT_S)
                    outcomes[arm] = []
                    for task in range(1, num_tasks + 1):
                        outcomes[arm].append(client.drive(task, settings.seed, settings.timeout_s))
                        bar.update()
                except NoAnswerError as error:
                    logs_seen = (node.describe('still runs') for node in running)
                    raise NoAnswerError('\n'.join([str(error), *logs_seen])) from error
                client.destroy_node()
    return outcomes


def report(settings: DemoSettings, outcomes: dict[str, list[GoalOutcome]]) -> None:
    """Print the table; write the summary and the picture."""
    summary = {
        'environment': _ENVIRONMENT,
        'settings': settings.model_dump(mode='json'),
        **provenance(),
        'arms': {
            arm: [{'task': task, **numbers(outcome)} for task, outcome in enumerate(results, 1)]
            for arm, results in outcomes.items()
        },
    }
    with atomic_write(settings.out / 'summary.json') as file:
        file.write((json.dumps(summary, indent=2) + '\n').encode())
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
    lines = [
        '| arm | goals reached | steps by task | adaptation ms (median) | transitions (median) |',
        '|---|---|---|---|---|',
    ]
    for arm, goals in arms.items():
        reached = sum(goal['success'] for goal in goals)
        steps = ', '.join(str(g['steps']) if g['success'] else 'missed' for g in goals)
        adaptation = np.median([goal['adaptation_ms'] for goal in goals])
        transitions = np.median([goal['transitions'] for goal in goals])
        lines.append(
            f'| {arm} | {reached} of {len(goals)} | {steps} '
            f'| {adaptation:.0f} | {transitions:.0f} |'
        )
    return '\n'.join(lines)


def check(nodes: list[NodeProcess]) -> None:
    """Raise if a node has died."""
    for node in nodes:
        node.check()


@contextmanager
def own_domain() -> Iterator[None]:
    """A ROS domain that no other program on this machine uses, unless one is set already."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    if 'ROS_DOMAIN_ID' in os.environ:
        yield
        return
    # Left by hand: its own `with` block would take an OSError from the body for a taken domain.
    reservation = domain_id()
    os.environ['ROS_DOMAIN_ID'] = str(reservation.__enter__())
    try:
        yield
    finally:
        del os.environ['ROS_DOMAIN_ID']
        reservation.__exit__(None, None, None)


if __name__ == '__main__':
    main()
