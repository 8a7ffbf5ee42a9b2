"""Generation of offline datasets: parallel, resumable, one file at the end."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from metagcttt_core.data import TrajectoryDataset
from metagcttt_core.files import read_json, write_json
import numpy as np

from sim_bridge.controllers import DirectionFollower, make_direction_follower
from sim_bridge.controllers.posture import count_falls
from sim_bridge.generation.chunks import (
    Chunk,
    ChunkFolder,
    GenerationError,
    PER_ROW,
    plan_chunks,
    refuse_difference,
)
from sim_bridge.generation.plan import GenerationPlan
from sim_bridge.generation.workers import record_chunks
from sim_bridge.registry import describe_environment

FORMAT_VERSION = 1
PHYSICS_PACKAGES = ('mujoco', 'numpy', 'ogbench')

Progress = Callable[[int, int], None]
"""Called with the number of finished episodes and the total."""


@dataclass(frozen=True)
class OutputPaths:
    """Paths of the files that make up a dataset."""

    train: Path

    def __post_init__(self) -> None:
        """Refuse a name without the suffix .npz."""
        if self.train.suffix != '.npz':
            raise GenerationError(f'the output must end in .npz, got {self.train}')

    @property
    def validation(self) -> Path:
        """Validation episodes, named as OGBench names them."""
        return self.train.with_name(f'{self.train.stem}-val.npz')

    @property
    def sidecar(self) -> Path:
        """Settings, versions and statistics; written last, so its presence marks completion."""
        return self.train.with_suffix('.json')

    @property
    def partial(self) -> Path:
        """Folder of the finished chunks while the dataset is in progress."""
        return self.train.with_suffix('.partial')


@dataclass(frozen=True)
class DatasetStatistics:
    """Statistics of a dataset, of the training file unless stated otherwise.

    Attributes:
        rows: Rows of the training file.
        validation_rows: Rows of the validation file.
        goals_per_episode: Mean number of goals reached in an episode.
        coverage: Fraction of the free cells that were visited, 0 to 1.
        falls_per_episode: Mean number of falls in an episode; 0 for a robot that cannot fall.
    """

    rows: int
    validation_rows: int
    goals_per_episode: float
    coverage: float
    falls_per_episode: float = 0.0


def generate(
    plan: GenerationPlan,
    output: Path,
    processes: int = 1,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    controller: Path | None = None,
) -> DatasetStatistics:
    """Generate a dataset in OGBench's format.

    Writes `NAME.npz`, `NAME-val.npz` and, last, `NAME.json` (settings, versions, statistics).
    The files depend on the plan, the controller and the physics packages, not on `processes`.
    An interruption loses at most the chunks being recorded; `resume` keeps the others.

    Args:
        plan: What to generate.
        output: Path of `NAME.npz`.
        processes: Worker processes; 1 records in this process.
        resume: Continue what an earlier call for the same plan left; a complete dataset is left
            as it is.
        overwrite: Discard what an earlier call left; files that none made are kept.
        progress: Called as episodes finish.
        controller: Folder of the learned controller to use, for a robot that needs one; by
            default the bundled one.

    Returns:
        Statistics of the dataset.

    Raises:
        GenerationError: If the output exists and neither flag is given, or no call of this made
            it; if it was generated with other settings; if a worker process died.
        ControllerError: If the robot needs a controller and there is none.
    """
    if processes < 1:
        raise GenerationError(f'processes must be at least 1, got {processes}')
    follower = make_direction_follower(describe_environment(plan.environment).spec, controller)
    paths = OutputPaths(output)
    folder = ChunkFolder(paths.partial)
    settings = _settings(plan, follower)
    begun = folder.exists() or paths.sidecar.exists()
    if overwrite and begun:
        if paths.sidecar.exists():
            _stored(paths.sidecar)  # or it is not ours to remove
        folder.remove()
        folder.open(settings)  # before the sidecar goes: whenever this dies, it is known as ours
        paths.sidecar.unlink(missing_ok=True)
    elif not (resume and begun):
        _refuse_existing(paths, begun)
    elif paths.sidecar.exists():
        statistics = _finished(paths.sidecar, settings)
        folder.remove()
        return statistics
    folder.open(settings)
    chunks = plan_chunks(plan)
    missing = [chunk for chunk in chunks if not folder.has(chunk)]
    total = sum(chunk.stop - chunk.start for chunk in chunks)
    done = total - sum(chunk.stop - chunk.start for chunk in missing)
    if progress:
        progress(done, total)
    for chunk in record_chunks(plan, missing, folder, processes, controller):
        done += chunk.stop - chunk.start
        if progress:
            progress(done, total)
    statistics = _assemble(plan, chunks, folder, paths)
    write_json(paths.sidecar, {**settings, 'statistics': asdict(statistics)})
    folder.remove()
    return statistics


def kept_settings(output: Path) -> tuple[Path, dict[str, Any]] | None:
    """The settings of a dataset in progress or complete, and their file; None without any."""
    paths = OutputPaths(output)
    partial = ChunkFolder(paths.partial)
    if partial.exists():
        return paths.partial, partial.settings()
    if paths.sidecar.exists():
        return paths.sidecar, _stored(paths.sidecar)[0]
    return None


def _settings(plan: GenerationPlan, follower: DirectionFollower) -> dict[str, Any]:
    """All settings that determine the content of a dataset."""
    sha256 = getattr(follower, 'sha256', None)  # of learned weights
    controller = {'controller_sha256': sha256} if sha256 else {}
    versions = {f'{package}_version': version(package) for package in PHYSICS_PACKAGES}
    settings = plan.model_dump(exclude_defaults=True)
    return {'format_version': FORMAT_VERSION, **settings, **controller, **versions}


def _refuse_existing(paths: OutputPaths, begun: bool) -> None:
    if ChunkFolder(paths.partial).exists():
        raise GenerationError(
            f'{paths.partial} holds an unfinished dataset: resume it or overwrite it'
        )
    for path in (paths.train, paths.validation, paths.sidecar):
        if path.exists():
            if not begun:
                raise GenerationError(
                    f'{path} exists and was not generated here ({paths.sidecar.name} is missing): '
                    'move it or choose another output'
                )
            raise GenerationError(f'{path} exists: overwrite it or choose another output')


def _finished(sidecar: Path, settings: dict[str, Any]) -> DatasetStatistics:
    """Statistics of a complete dataset, once its settings are verified."""
    stored, statistics = _stored(sidecar)
    refuse_difference(sidecar, stored, settings)
    return statistics


def _stored(sidecar: Path) -> tuple[dict[str, Any], DatasetStatistics]:
    """Settings and statistics of a complete dataset."""
    try:
        stored = read_json(sidecar)
        return stored, DatasetStatistics(**stored.pop('statistics'))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise GenerationError(
            f'{sidecar} describes no generated dataset: move it or choose another output'
        ) from error


def _assemble(
    plan: GenerationPlan, chunks: list[Chunk], folder: ChunkFolder, paths: OutputPaths
) -> DatasetStatistics:
    """Join the chunks into the two files of the dataset."""
    train = [folder.read(chunk) for chunk in chunks if not chunk.validation]
    validation = [folder.read(chunk) for chunk in chunks if chunk.validation]
    validation_set = _join(validation)
    validation_set.save(paths.validation)
    train_set = _join(train)
    train_set.save(paths.train)

    description = describe_environment(plan.environment)
    positions = train_set.observations[:, list(description.spec.position_dims)]
    free = ~description.maze.walls
    visited = description.maze.count_visits(positions) > 0
    return DatasetStatistics(
        rows=train_set.num_rows,
        validation_rows=validation_set.num_rows,
        goals_per_episode=float(np.concatenate([part['goals_reached'] for part in train]).mean()),
        coverage=float((visited & free).sum() / free.sum()),
        falls_per_episode=_falls(train) / plan.episodes,
    )


def _falls(parts: list[dict[str, np.ndarray]]) -> int:
    return sum(
        count_falls(qpos)
        for part in parts
        for qpos in np.split(part['qpos'], np.flatnonzero(part['terminals'])[:-1] + 1)
    )


def _join(parts: list[dict[str, np.ndarray]]) -> TrajectoryDataset:
    joined = {name: np.concatenate([part[name] for part in parts]) for name in PER_ROW}
    return TrajectoryDataset.from_arrays(
        joined['observations'],
        joined['actions'],
        joined['terminals'],
        extras={'qpos': joined['qpos'], 'qvel': joined['qvel']},
    )
