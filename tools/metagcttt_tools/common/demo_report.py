"""What the demos of mazes and of robots share: assets, three policies, summary and picture."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import assets_dir
from metagcttt_core.files import write_json
import numpy as np
from sim_bridge.maze_map import MazeMap

from metagcttt_tools.common.session import provenance

_PARTS = ('base', 'meta', 'dataset.npz')


class Outcome(Protocol):
    """The outcome of one goal."""

    @property
    def success(self) -> bool:
        """Whether the goal was reached."""

    @property
    def path(self) -> list[tuple[float, float]]:
        """(x, y) in metres at each step."""

    @property
    def report(self) -> Any:
        """The adaptation to this goal."""


OutcomeT = TypeVar('OutcomeT', bound=Outcome)


def packed_assets(name: str, preset: str) -> Path:
    """The folder of a demo's policies and data.

    Args:
        name: Of the folder in the committed assets.
        preset: That trains and packs them.

    Raises:
        FileNotFoundError: If something is missing; says which command packs it.
    """
    folder = assets_dir() / name
    missing = [part for part in _PARTS if not (folder / part).exists()]
    if missing:
        raise FileNotFoundError(
            f'{folder} lacks {", ".join(missing)}: `metagcttt pack-assets --preset {preset}` '
            'packs what that preset has trained'
        )
    return folder


def arms_of(assets: Path, steps: int) -> dict[str, tuple[Path, int]]:
    """Checkpoint and number of gradient steps by arm: base, base + TTT, meta + TTT."""
    return {
        'base policy': (assets / 'base', 0),
        f'base + TTT (K = {steps})': (assets / 'base', steps),
        f'meta + TTT (K = {steps})': (assets / 'meta', steps),
    }


def write_report(
    out: Path,
    about: Mapping[str, Any],
    outcomes: Mapping[str, Sequence[OutcomeT]],
    numbers: Callable[[OutcomeT], dict[str, Any]],
    picture: Callable[[Path], None],
) -> None:
    """Write OUT/summary.json and OUT/demo.png and say so.

    Args:
        out: The folder.
        about: What was driven, with which settings.
        outcomes: Of each task by arm.
        numbers: The figures of an outcome.
        picture: Writes the picture to a file.
    """
    arms = {
        arm: [{'task': task, **numbers(outcome)} for task, outcome in enumerate(results, 1)]
        for arm, results in outcomes.items()
    }
    write_json(out / 'summary.json', {**about, **provenance(), 'arms': arms})
    picture(out / 'demo.png')
    print(f'summary: {out / "summary.json"}\npicture: {out / "demo.png"}')


def draw(
    maze: MazeMap,
    dataset: Path,
    goals: Sequence[tuple[float, float]],
    outcomes: Mapping[str, Sequence[Outcome]],
    path: Path,
) -> None:
    """Draw one panel a task, with what the last arm retrieved, to a file.

    Args:
        maze: The maze or room.
        dataset: What was adapted on; positions are its first two values.
        goals: (x, y) of each task's goal, metres.
        outcomes: Of each task by arm.
        path: The file.
    """
    from metagcttt_tools.common.plots import demo_picture, save

    observations = TrajectoryDataset.load(dataset).observations
    last = list(outcomes.values())[-1]
    figure = demo_picture(
        maze,
        paths={arm: [np.array(each.path) for each in drives] for arm, drives in outcomes.items()},
        successes={arm: [each.success for each in drives] for arm, drives in outcomes.items()},
        segments=[
            [
                observations[start:stop, :2]
                for start, stop in zip(
                    each.report.segment_starts, each.report.segment_stops, strict=True
                )
            ]
            for each in last
        ],
        goals=goals,
    )
    save(figure, path)
