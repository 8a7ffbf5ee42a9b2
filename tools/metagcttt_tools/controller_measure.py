"""Measure how well a learned controller follows directions."""

import math
from pathlib import Path
from typing import Any

from metagcttt_core.config import Settings
from metagcttt_core.files import write_json, write_text
import numpy as np
from pydantic import Field
from sim_bridge.controllers import HumanoidFollower, LearnedFollower, load_follower
from sim_bridge.controllers.direction import BUNDLED, GET_UP
from sim_bridge.controllers.rising import RisingHumanoid
from sim_bridge.controllers.walk import (
    QUARTER_TURNS_RAD,
    stands_up,
    TURN_EVERY_S,
    Walk,
    walk_along,
    walk_to_goal,
)
from sim_bridge.mazes.ogbench import OGBenchMaze
from sim_bridge.mazes.ogbench_layouts import UNIT_M
from tqdm import tqdm

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.results import beside, markdown_table
from metagcttt_tools.common.session import ours_or_fail, provenance, sole_writer
from metagcttt_tools.controller.film import film

_DESCRIPTION = """Measure how well a learned controller follows directions.

Example: metagcttt controller measure --controller out/humanoid-controller/controller
Walks along each direction on an open floor; then as long straight on and with turns by 0 or 90
degrees every 2.5 s, each without and with noisy actions; then to the goals of the robot's mazes
by the shortest way, where a fall ends an episode. All start upright in random poses. A humanoid is
also dropped as OGBench drops it, to get up, and to go to the same goals, up again after each fall.
Prints tables and writes OUT.json, OUT.md and OUT.png, and with --gif a picture of it walking."""


class MeasureSettings(Settings):
    """Settings of the program."""

    controller: Path = Field(BUNDLED / 'ant', description='folder of the controller')
    directions: int = Field(8, ge=1, description='directions, spread evenly')
    duration_s: float = Field(20.0, gt=0, description='of a walk, simulated seconds')
    repeats: int = Field(5, ge=1, description='walks per direction, each from another pose')
    walks: int = Field(20, ge=1, description='walks straight on or with turns')
    mazes: tuple[str, ...] = Field(('medium', 'large'), description='layouts to reach goals in')
    drops: int = Field(30, ge=1, description='of a humanoid, that shall get up')
    episodes_per_task: int = Field(2, ge=1, description='in each maze')
    action_noise: float = Field(0.2, ge=0, description='standard deviation in the noisy rows')
    seed: int = Field(0, ge=0, description='random seed')
    out: Path = Field(Path('out/controller'), description='files to write, without suffix')
    gif: Path | None = Field(None, description='also film a walk with turns, to this file')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(MeasureSettings, _DESCRIPTION, 'controller measure', argv)
    record, table, picture = (beside(settings.out, end) for end in ('.json', '.md', '.png'))
    with sole_writer(record, record, table, picture):
        if settings.gif is not None:
            ours_or_fail(settings.gif)
        _run(settings, record, table, picture)


def _run(settings: MeasureSettings, record: Path, table: Path, picture: Path) -> None:
    from metagcttt_tools.common.plots import controller_picture, save

    try:
        follower = load_follower(settings.controller)
    except ValueError as error:
        fail(str(error))
    rising = isinstance(follower, HumanoidFollower)
    walks = [
        [
            walk_along(follower, direction, settings.duration_s, settings.seed + repeat)
            for repeat in range(settings.repeats)
        ]
        for direction in tqdm(compass(settings.directions), unit='direction')
    ]
    tables = {
        'directions': [summarize(same_direction) for same_direction in walks],
        'walks': [
            summarize_walks(follower, settings, turns, noise)
            for turns in ((), QUARTER_TURNS_RAD)
            for noise in (0.0, settings.action_noise)
        ],
        'rises': [summarize_rises(settings)] if rising else [],
        'mazes': [
            summarize_goals(follower, settings, layout, noise, dropped)
            for layout in settings.mazes
            for dropped in ((False, True) if rising else (False,))
            for noise in (0.0, settings.action_noise)
        ],
    }
    report = {
        'settings': settings.model_dump(mode='json', exclude={'controller', 'out', 'gif'}),
        'controller_sha256': follower.sha256,
        'training': follower.metadata,
        **provenance(),
        **tables,
    }
    write_json(record, report)
    text = format_tables(tables)
    write_text(table, text)
    save(controller_picture(walks), picture)
    print(text)
    print(f'results: {record}, .md and .png')
    if settings.gif is not None:
        film(follower, settings.gif, settings.seed)
        print(f'film: {settings.gif}')


def compass(count: int) -> list[np.ndarray]:
    """Unit vectors (x, y), spread evenly, beginning along x."""
    angles = [2 * math.pi * number / count for number in range(count)]
    return [np.array([math.cos(angle), math.sin(angle)]) for angle in angles]


def summarize(walks: list[Walk]) -> dict[str, Any]:
    """The figures of walks along one direction."""
    speeds = [walk.speed for walk in walks]
    angle = math.degrees(math.atan2(walks[0].direction[1], walks[0].direction[0]))
    speed = float(np.mean(speeds))
    return {
        'direction_deg': round(angle) % 360,
        'speed_m_s': speed,
        'slowest_m_s': min(speeds),
        'drift_m': float(np.mean([abs(walk.drift_m) for walk in walks])),
        'steps_per_cell': UNIT_M / (speed * walks[0].period_s) if speed > 0 else None,
        'falls': sum(walk.falls for walk in walks),
        'walks': len(walks),
    }


def summarize_walks(
    follower: LearnedFollower,
    settings: MeasureSettings,
    turns_rad: tuple[float, ...],
    action_noise: float,
) -> dict[str, Any]:
    """The figures of walks straight on or with turns, each along another direction."""
    walks = [
        walk_along(
            follower, direction, settings.duration_s, settings.seed + number, turns_rad,
            action_noise,
        )
        for number, direction in enumerate(compass(settings.walks))
    ]  # fmt: skip
    falls, walked_s = sum(walk.falls for walk in walks), sum(walk.duration_s for walk in walks)
    return {
        'turns_deg': [round(math.degrees(turn)) for turn in turns_rad],
        'action_noise': action_noise,
        'speed_m_s': float(np.mean([walk.speed for walk in walks])),
        'falls': falls,
        'walked_s': walked_s,
        'falls_per_minute': 60 * falls / walked_s,
    }


def summarize_rises(settings: MeasureSettings) -> dict[str, Any]:
    """How often the humanoid stands after OGBench's drop."""
    riser = HumanoidFollower.load(GET_UP)
    maze = OGBenchMaze('humanoidmaze-medium-v0')
    with maze:
        stood = {
            f'stood_after_{within_s}_s': sum(
                stands_up(riser, maze, settings.seed + number, within_s)
                for number in range(settings.drops)
            )
            for within_s in (5, 10)
        }
    return {'drops': settings.drops, **stood, 'controller_sha256': riser.sha256}


def summarize_goals(
    follower: LearnedFollower,
    settings: MeasureSettings,
    layout: str,
    action_noise: float,
    dropped: bool,
) -> dict[str, Any]:
    """The figures of the tasks of a maze, `dropped` with a humanoid that gets up."""
    maze = OGBenchMaze(f'{follower.robot}maze-{layout}-v0')
    riser = HumanoidFollower.load(GET_UP) if dropped else None
    with maze:
        runs = [
            walk_to_goal(
                RisingHumanoid(follower, riser) if riser else follower,
                maze,
                task.task_id,
                settings.seed + number,
                action_noise,
                dropped,
            )
            for task in maze.tasks
            for number in range(settings.episodes_per_task)
        ]
    durations = [run.duration_s for run in runs if run.reached]
    falls, walked_s = sum(run.falls for run in runs), sum(run.duration_s for run in runs)
    return {
        'maze': f'{follower.robot}maze-{layout}-v0',
        'start': 'dropped' if dropped else 'upright',
        'action_noise': action_noise,
        'reached': len(durations),
        'episodes': len(runs),
        'seconds_to_goal': float(np.mean(durations)) if durations else None,
        'falls': falls,
        'walked_s': walked_s,
        'falls_per_minute': 60 * falls / walked_s,
    }


def format_tables(tables: dict[str, list[dict[str, Any]]]) -> str:
    """The figures as Markdown."""
    cell = f'control steps per {UNIT_M:g} m cell'
    directions = [
        {
            'direction': f'{row["direction_deg"]}°',
            'speed (m/s)': f'{row["speed_m_s"]:.2f}',
            'slowest walk': f'{row["slowest_m_s"]:.2f}',
            cell: 'never' if row['steps_per_cell'] is None else f'{row["steps_per_cell"]:.0f}',
            'drift (m)': f'{row["drift_m"]:.1f}',
            'falls': f'{row["falls"]} in {row["walks"]}',
        }
        for row in tables['directions']
    ]
    walks = [
        {
            'walk': f'0 or ±90° every {TURN_EVERY_S:g} s' if row['turns_deg'] else 'straight on',
            'action noise': f'{row["action_noise"]:g}',
            'speed (m/s)': f'{row["speed_m_s"]:.2f}',
            **_falls(row),
        }
        for row in tables['walks']
    ]
    mazes = [
        {
            'maze': row['maze'],
            'start': row['start'],
            'action noise': f'{row["action_noise"]:g}',
            'goals': f'{row["reached"]} of {row["episodes"]}',
            'seconds to goal': 'never' if not row['reached'] else f'{row["seconds_to_goal"]:.1f}',
            **_falls(row),
        }
        for row in tables['mazes']
    ]
    rises = [
        {
            'start': 'dropped as by OGBench',
            'stands after 5 s': f'{row["stood_after_5_s"]} of {row["drops"]}',
            'after 10 s': f'{row["stood_after_10_s"]} of {row["drops"]}',
        }
        for row in tables['rises']
    ]
    return '\n\n'.join(map(markdown_table, filter(None, (directions, walks, rises, mazes)))) + '\n'


def _falls(row: dict[str, Any]) -> dict[str, str]:
    return {
        'falls': f'{row["falls"]} in {row["walked_s"]:.0f} s',
        'falls a minute': f'{row["falls_per_minute"]:.2f}',
    }
