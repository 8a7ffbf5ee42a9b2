"""What the long-running tools share: logs, provenance, interruption."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
import json
from pathlib import Path
import signal
import subprocess
import threading
import time
from typing import Any, Self

from metagcttt_core.config import Settings
from metagcttt_core.training.checkpoint import has_checkpoint, load_training_state
from metagcttt_core.training.run import TrainingInterrupted, TrainingRun
from pydantic import Field
import torch
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from tools.cli import fail

_PACKAGES = ('torch', 'numpy', 'mujoco', 'ogbench')


class RunLog:
    """Scalars of a run, to TensorBoard and to the JSON-lines file `metrics.jsonl`."""

    def __init__(self, folder: Path, first_step: int) -> None:
        """Open the logs in `folder`; lines of a resumed run beyond `first_step` are dropped."""
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / 'metrics.jsonl'
        kept: list[str] = []
        if first_step > 0 and self._path.exists():
            lines = self._path.read_text(encoding='utf-8').splitlines()
            kept = [line for line in lines if json.loads(line)['step'] <= first_step]
        self._file = self._path.open('w', encoding='utf-8')
        self._file.writelines(f'{line}\n' for line in kept)
        self._writer = SummaryWriter(str(folder / 'tensorboard'), purge_step=first_step)

    def write(self, step: int, scalars: Mapping[str, float | None]) -> None:
        """Record scalars by name; those that are None are left out."""
        known = {name: value for name, value in scalars.items() if value is not None}
        self._file.write(json.dumps({'step': step, 'time': round(time.time(), 3), **known}) + '\n')
        self._file.flush()
        for name, value in known.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Flush and close."""
        self._file.close()
        self._writer.close()

    def __enter__(self) -> Self:
        """The log itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


class RunSettings(Settings):
    """Settings that the training tools share."""

    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='offline dataset (npz)'
    )
    out: Path = Field(Path('out/run'), description='folder of the run')
    seed: int = Field(0, ge=0, description='of everything random')
    checkpoint_every: int = Field(1000, ge=1, description='steps between checkpoints')
    log_every: int = Field(100, ge=1, description='steps between log lines')
    threads: int = Field(1, ge=1, description='threads for tensor operations')
    resume: bool = Field(False, description='go on from the checkpoint in OUT, if there is one')

    @property
    def checkpoint_folder(self) -> Path:
        """Where the run's checkpoint is."""
        return self.out / 'checkpoint'


@dataclass(frozen=True)
class Session:
    """A run in progress: its checkpoints, logs and progress bar."""

    run: TrainingRun
    log: RunLog
    bar: tqdm


@contextmanager
def training_session(
    settings: RunSettings, stage: str, decisive: dict[str, Any], steps: int
) -> Iterator[Session]:
    """Logs, checkpoints and a clean end for a training tool.

    Args:
        settings: The tool's settings.
        stage: `pretrain` or `post_train`.
        decisive: Everything that decides the result; see `TrainingRun`.
        steps: Number of steps of the whole run.

    Raises:
        SystemExit: With status 130 after Ctrl-C or SIGTERM, everything done so far being saved.
    """
    folder = settings.checkpoint_folder
    exists = has_checkpoint(folder)
    if exists and not settings.resume:
        fail(f'{folder} holds a checkpoint: go on with --resume, or choose another --out')
    write_settings(settings.out, settings)
    first = load_training_state(folder).step if exists else 0
    with (
        stop_on_signal() as stop,
        RunLog(settings.out, first) as log,
        tqdm(total=steps, initial=first, unit='step', desc=stage) as bar,
    ):
        run = TrainingRun(
            stage,
            decisive,
            folder,
            every=settings.checkpoint_every,
            resume=settings.resume,
            should_stop=stop.is_set,
        )
        try:
            yield Session(run, log, bar)
        except TrainingInterrupted as interruption:
            bar.close()
            print(f'{interruption}; go on with --resume')
            raise SystemExit(130) from interruption
    print(f'policy: {folder}')


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets, so that a run can save before it ends."""
    stop = threading.Event()

    def request(signum: int, frame: object) -> None:
        stop.set()

    signals = (signal.SIGINT, signal.SIGTERM)
    previous = {number: signal.signal(number, request) for number in signals}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def provenance() -> dict[str, Any]:
    """Commit and package versions that a result comes from."""
    try:
        commit = subprocess.run(
            ['git', 'describe', '--always', '--dirty', '--exclude=*'],
            capture_output=True,
            text=True,
            check=True,
            cwd=Path(__file__).parent,
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = 'unknown'  # not a checkout, or no git
    return {'commit': commit, 'versions': {name: version(name) for name in _PACKAGES}}


def write_settings(folder: Path, settings: Settings) -> None:
    """The resolved settings, beside a run's results."""
    folder.mkdir(parents=True, exist_ok=True)
    record = {'settings': settings.model_dump(mode='json'), **provenance()}
    (folder / 'settings.json').write_text(json.dumps(record, indent=2) + '\n', encoding='utf-8')


def use_threads(count: int) -> None:
    """Threads for tensor operations; results are repeatable for an equal count."""
    torch.set_num_threads(count)
