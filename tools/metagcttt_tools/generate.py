"""Generate an offline dataset of a maze: navigate, stitch or explore, in OGBench's format."""

from collections.abc import Mapping
import os
from pathlib import Path
import sys
import time
from typing import Any

from metagcttt_core import TrajectoryDataset
from pydantic import Field
from sim_bridge import describe_environment
from sim_bridge.generation.behaviours import Kind
from sim_bridge.generation.generate import generate, kept_settings, OutputPaths
from sim_bridge.generation.plan import plan_dataset
from tqdm import tqdm

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.resume import Resumable
from metagcttt_tools.common.session import ours_or_fail, sole_writer

DESCRIPTION = """Generate an offline dataset of a maze in OGBench's npz format.

A behaviour policy walks the robot through the maze with noisy actions:
  navigate  one goal after another, anywhere but in corridors
  stitch    one goal four cells away, where it stays (short episodes to be stitched together)
  explore   a new random direction every ten steps

Without further flags the dataset has OGBench's size and noise. The same settings give the same
files on any number of processes. Ctrl-C is safe: --resume, with no
other flag than --output, continues.

Example, 1000 episodes of 1001 rows, about two minutes on one core:

  metagcttt generate --environment pointmaze-medium-v0 --kind navigate

writes data/pointmaze-medium-navigate-v0.npz, ...-val.npz (a tenth as many episodes),
...-v0.json (settings, versions, statistics) and ...-v0.png (where the robot has been).

Ant and humanoid walk by the controllers in sim_bridge/controllers/weights; --controller takes
another. The humanoid is dropped as OGBench drops it, and gets up, then and after falls; with
--standing it starts on its feet, its episodes end a second before a fall, and its data are named
MAZE-KIND-standing-v0.
Where there is a network, metagcttt download fetches OGBench's published files instead."""


class GenerateSettings(Resumable):
    """Settings of one generated dataset."""

    may_change = frozenset({'processes', 'controller', 'overwrite'})
    place = 'output'

    environment: str = Field('pointmaze-medium-v0', description='Name of the maze.')
    kind: Kind = Field('navigate', description='Behaviour policy.')
    episodes: int | None = Field(
        None, ge=1, description="Training episodes; OGBench's number by default."
    )
    rows_per_episode: int | None = Field(
        None, ge=2, description="Rows of an episode (transitions + 1); OGBench's by default."
    )
    noise: float | None = Field(
        None, ge=0, description="Standard deviation of the action noise; OGBench's by default."
    )
    to_goal: bool = Field(
        False,
        description="Walk to the goal itself; OGBench walks to the center of the goal's cell.",
    )
    standing: bool = Field(
        False,
        description='Start a humanoid on its feet, and end its episodes a second before a fall.',
    )
    seed: int = Field(0, ge=0, description='Random seed.')
    output: Path | None = Field(
        None,
        description='Path ending in .npz; by default data/MAZE-KIND-v0.npz, with '
        '--standing data/MAZE-KIND-standing-v0.npz.',
    )
    processes: int = Field(
        default_factory=lambda: len(os.sched_getaffinity(0)),
        ge=1,
        description='Worker processes; all cores by default.',
    )
    controller: Path | None = Field(
        None, description='Folder of a learned controller; the one of the package by default.'
    )
    overwrite: bool = Field(False, description='Replace an existing dataset.')

    @property
    def file(self) -> Path:
        """The dataset to write, by default named as OGBench names it.

        That of a humanoid that starts standing is named otherwise, as OGBench drops it.

        Raises:
            ValueError: If that is to have the name of one of OGBench's.
        """
        maze = describe_environment(self.environment).spec.name.removesuffix('-v0')
        name = f'{maze}-{self.kind}-v0'
        if self.standing:
            if self.output and self.output.stem == name:
                raise ValueError(
                    f"{self.output}: is the name of OGBench's data, whose humanoid is dropped "
                    'and gets up; choose another for data that start standing'
                )
            name = f'{maze}-{self.kind}-standing-v0'
        return self.output or Path('data') / f'{name}.npz'

    def kept(self) -> tuple[Path, Mapping[str, Any]] | None:
        """The settings of the dataset that is in progress or complete."""
        kept = kept_settings(self.file)
        if kept is None:
            return None
        file, values = kept
        return file, {name: values[name] for name in values if name in type(self).model_fields}


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(GenerateSettings, DESCRIPTION, 'generate', argv)
    try:
        with sole_writer(settings.file):
            _run(settings)
    except ValueError as error:
        fail(str(error))
    except KeyboardInterrupt:
        print('interrupted; pass --resume to continue', file=sys.stderr)
        raise SystemExit(130) from None


def _run(settings: GenerateSettings) -> None:
    started = time.monotonic()
    plan = plan_dataset(
        settings.environment,
        settings.kind,
        seed=settings.seed,
        episodes=settings.episodes,
        rows_per_episode=settings.rows_per_episode,
        noise=settings.noise,
        to_goal=settings.to_goal,
        standing=settings.standing,
    )
    output = settings.file
    picture = output.with_suffix('.png')
    if not OutputPaths(output).sidecar.exists():
        ours_or_fail(picture)
    with tqdm(unit=' episodes', desc=output.stem, delay=0.5) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        statistics = generate(
            plan,
            output,
            processes=settings.processes,
            resume=settings.resume,
            overwrite=settings.overwrite,
            progress=show,
            controller=settings.controller,
        )
    _draw(plan.environment, output, picture)
    print(f'wrote     {output} and {OutputPaths(output).validation.name}')
    print(f'episodes  {plan.episodes} + {plan.validation_episodes} for validation')
    print(f'rows      {statistics.rows} + {statistics.validation_rows}')
    print(f'goals     {statistics.goals_per_episode:.2f} reached per episode')
    print(f'falls     {statistics.falls_per_episode:.3f} per episode')
    print(f'coverage  {statistics.coverage:.1%} of the free cells visited')
    print(f'picture   {picture}')
    print(f'seconds   {time.monotonic() - started:.1f}')


def _draw(environment: str, dataset: Path, picture: Path) -> None:
    from metagcttt_tools.common.plots import coverage_picture, save

    description = describe_environment(environment)
    positions = TrajectoryDataset.load(dataset).observations[:, description.spec.position_dims]
    save(coverage_picture(description.maze, positions), picture)
