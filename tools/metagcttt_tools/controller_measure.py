"""Measure how well a learned controller follows directions."""

import math
from pathlib import Path
from typing import Any

from metagcttt_core.config import Settings
from metagcttt_core.files import write_json
import numpy as np
from pydantic import Field
from sim_bridge.controllers import load_follower
from sim_bridge.controllers.direction import BUNDLED
from sim_bridge.controllers.walk import Walk, walk_along
from sim_bridge.mazes.ogbench_layouts import UNIT_M
from tqdm import tqdm

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.plots import controller_picture, save
from metagcttt_tools.common.session import provenance

_DESCRIPTION = """Measure how well a learned controller follows directions.

Example: metagcttt controller measure --controller out/ant-controller/controller
Walks along each direction on an open floor from random start poses, without noise; prints a
table and writes OUT.json and OUT.png."""


class MeasureSettings(Settings):
    """Settings of the tool."""

    controller: Path = Field(BUNDLED / 'ant', description='folder of the controller')
    directions: int = Field(8, ge=1, description='directions, spread evenly')
    duration_s: float = Field(20.0, gt=0, description='of a walk, simulated seconds')
    repeats: int = Field(5, ge=1, description='walks per direction, each from another pose')
    seed: int = Field(0, ge=0, description='of the start poses')
    out: Path = Field(Path('out/controller'), description='files to write')


def main(argv: list[str] | None = None) -> None:
    """Run the tool."""
    settings = parse(MeasureSettings, _DESCRIPTION, 'controller measure', argv)
    try:
        follower = load_follower(settings.controller)
    except ValueError as error:
        fail(str(error))
    walks = [
        [
            walk_along(follower, direction, settings.duration_s, settings.seed + repeat)
            for repeat in range(settings.repeats)
        ]
        for direction in tqdm(compass(settings.directions), unit='direction')
    ]
    rows = [summarize(same_direction) for same_direction in walks]
    report = {
        'settings': settings.model_dump(mode='json', exclude={'controller', 'out'}),
        'controller_sha256': follower.sha256,
        'training': follower.metadata,
        **provenance(),
        'directions': rows,
    }
    write_json(settings.out.with_suffix('.json'), report)
    save(controller_picture(walks), settings.out.with_suffix('.png'))
    print(format_table(rows))
    print(f'results: {settings.out.with_suffix(".json")} and .png')


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


def format_table(rows: list[dict[str, Any]]) -> str:
    """One line a direction, as Markdown."""
    lines = [
        f'| direction | speed (m/s) | slowest walk | control steps per {UNIT_M:g} m cell '
        '| drift (m) | falls |',
        '|---|---|---|---|---|---|',
    ]
    for row in rows:
        steps = 'never' if row['steps_per_cell'] is None else f'{row["steps_per_cell"]:.0f}'
        lines.append(
            f'| {row["direction_deg"]}° | {row["speed_m_s"]:.2f} | {row["slowest_m_s"]:.2f} '
            f'| {steps} | {row["drift_m"]:.1f} | {row["falls"]} in {row["walks"]} |'
        )
    return '\n'.join(lines)
