"""A training run in progress: logs, checkpoints, interruption, provenance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
import os
from pathlib import Path
import subprocess
import sys
from typing import Any, ClassVar, TYPE_CHECKING

from filelock import FileLock, Timeout
from metagcttt_core.config import Settings
from metagcttt_core.files import in_words, refuse_foreign, write_json
from pydantic import Field, field_validator
from tqdm import tqdm

from metagcttt_tools.common.cli import fail
from metagcttt_tools.common.resume import leaves, nested, Resumable
from metagcttt_tools.common.run_log import METRICS, RunLog, SilentLog
from metagcttt_tools.common.stopping import stop_on_signal

if TYPE_CHECKING:
    from metagcttt_core.training.run import TrainingRun

SETTINGS = 'settings.json'
SNAPSHOTS = 'snapshots'
_PACKAGES = ('torch', 'numpy', 'mujoco', 'ogbench')


def time_limit() -> Any:
    """The setting of that name."""
    return Field(
        None, gt=0, description='seconds after which the run saves and ends, to be queued again'
    )


class RunSettings(Resumable):
    """Settings that the training programs share."""

    # The data are known by their content, wherever they are.
    may_change: ClassVar[frozenset[str]] = frozenset(
        {
            'dataset',
            'checkpoint_every',
            'log_every',
            'snapshot_every',
            'device',
            'time_limit',
        }
    )

    dataset: Path = Field(
        Path('data/pointmaze-medium-navigate-v0.npz'), description='offline dataset (npz)'
    )
    out: Path = Field(Path('out/run'), description='folder of the run')
    seed: int = Field(0, ge=0, description='random seed')
    checkpoint_every: int = Field(1000, ge=1, description='steps between checkpoints')
    log_every: int = Field(100, ge=1, description='steps between log lines')
    threads: int = Field(1, ge=1, description='threads for tensor operations')
    device: str = Field('cpu', description='where to compute: cpu, cuda or cuda:NUMBER')
    time_limit: float | None = time_limit()

    @field_validator('device')
    @classmethod
    def _must_be_here(cls, device: str) -> str:
        import torch

        kind, _, number = device.partition(':')
        count = {'cpu': 1, 'cuda': torch.cuda.device_count()}.get(kind, 0)
        if not (number or '0').isdigit() or int(number or '0') >= count:
            raise ValueError(
                f'must be cpu, cuda or cuda:NUMBER; this machine has {torch.cuda.device_count()} '
                'CUDA devices'
            )
        return device

    @property
    def checkpoint_folder(self) -> Path:
        """Folder of the run's checkpoint."""
        return self.out / 'checkpoint'


@dataclass(frozen=True)
class Session:
    """A run in progress: its checkpoints, logs and progress bar."""

    run: TrainingRun
    log: RunLog
    bar: tqdm

    def warn(self, step: int, warnings: Sequence[str]) -> None:
        """Say what looks bad, above the progress bar."""
        for warning in warnings:
            self.bar.write(f'warning: after step {step}: {warning}', file=sys.stderr)


@contextmanager
def sole_writer(path: Path, *files: Path) -> Iterator[None]:
    """Keeps other processes from writing to the same results, and these from foreign files.

    The lock is the kernel's (on network file systems the server's), so it ends with its holder,
    however that ends.

    Args:
        path: The folder or file of the results; its lock lies beside it.
        files: What is going to be written, the record first; see `refuse_foreign`.

    Raises:
        SystemExit: With status 2 if another process writes there, or a file is somebody else's.
        OSError: If the lock cannot be written.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(FileLock(lock_of(path), timeout=0))
        except Timeout:
            other = 'another process is writing there; wait for its end or choose another place'
            fail(f'{path}: {other}')
        if files:
            ours_or_fail(*files)
        yield


def ours_or_fail(record: Path, *others: Path) -> None:
    """End the process with status 2 if one of these files is there and not ours."""
    try:
        refuse_foreign(record, *others)
    except FileExistsError as error:
        fail(str(error))


@contextmanager
def writes_dataset(path: Path, overwrite: bool) -> Iterator[None]:
    """As `sole_writer`, for a dataset that is only replaced on request, and if it is one of ours.

    Raises:
        SystemExit: With status 2, also if it exists and is not to be overwritten.
    """
    from metagcttt_core.data import DatasetError
    from metagcttt_core.data.dataset import MADE_FROM
    from metagcttt_core.data.npz import read_json

    with sole_writer(path):
        if path.exists() and not overwrite:
            fail(f'{path} exists: give --overwrite or another --out')
        if os.path.lexists(path):
            try:
                is_ours = not path.is_symlink() and path.is_file() and read_json(path, MADE_FROM)
            except DatasetError:
                is_ours = None
            if not is_ours:
                fail(f'{path} exists and is no imported dataset: move it elsewhere')
        yield


def lock_of(path: Path) -> Path:
    """The file that is locked while something writes to a folder or file of results.

    It is the same by whatever links they are reached.
    """
    place = path.resolve()
    place.parent.mkdir(parents=True, exist_ok=True)
    return place.parent / f'.{place.name}.lock'


@contextmanager
def training_session(
    settings: RunSettings, stage: str, decisive: dict[str, Any], steps: int
) -> Iterator[Session]:
    """Logs, checkpoints and a clean end for a training tool.

    Of the processes that `torchrun` starts, the first one writes.

    Args:
        settings: The tool's settings.
        stage: `pretrain` or `post_train`.
        decisive: Everything that decides the result; see `TrainingRun`.
        steps: Number of steps of the whole run.

    Raises:
        SystemExit: Everything done so far being saved, with status 130 after Ctrl-C and 75 after
            SIGTERM, SIGUSR1 or the time limit; with status 2 when something cannot be written, the
            last checkpoint being left whole.
    """
    from metagcttt_core.meta.parallel import any_process, first_process
    from metagcttt_core.training.run import TrainingInterrupted, TrainingRun
    import torch

    folder = settings.checkpoint_folder
    writes = first_process()
    try:
        with ExitStack() as stack:
            if writes:
                files = files_of_run(settings.out)
                stack.enter_context(sole_writer(settings.out, *files))
            first = _steps_to_continue_from(settings, steps)
            if writes:
                write_settings(settings.out, settings)
                if first:
                    print(f'continues after step {first}')
            stop = stack.enter_context(stop_on_signal(settings.time_limit))
            log = stack.enter_context(RunLog(settings.out, first) if writes else SilentLog())
            bar = stack.enter_context(
                tqdm(total=steps, initial=first, unit='step', desc=stage, disable=not writes)
            )
            run = TrainingRun(
                stage,
                decisive,
                folder,
                every=settings.checkpoint_every,
                resume=settings.resume,
                should_stop=lambda: any_process(stop.is_set(), torch.device(settings.device)),
                writes=writes,
            )
            yield Session(run, log, bar)
    except TrainingInterrupted as interruption:
        if writes:
            print(f'{interruption}; pass --resume to continue')
        raise SystemExit(stop.status) from interruption
    except OSError as error:
        fail(f'{settings.out}: cannot be written ({in_words(error)}); {left_behind(settings)}')
    if writes:
        print(f'policy: {folder}')


def files_of_run(folder: Path) -> tuple[Path, Path]:
    """What every run writes into its folder, the record first."""
    return folder / SETTINGS, folder / METRICS


def snapshot_folder(run: Path, step: int) -> Path:
    """The folder in which a run keeps its policy after `step` steps."""
    return run / SNAPSHOTS / f'{step:06d}'


def _steps_to_continue_from(settings: RunSettings, steps: int) -> int:
    """Steps that the run in its folder has done; ends the process where it cannot be continued."""
    from metagcttt_core.training.checkpoint import has_checkpoint, steps_done

    folder = settings.checkpoint_folder
    if has_checkpoint(folder) and not settings.resume:
        fail(f'{folder} holds a checkpoint: pass --resume to continue, or choose another --out')
    first = steps_done(folder)
    if first > steps:
        fail(f'{folder}: has {first} steps already, {steps} were asked for')
    return first


def left_behind(settings: RunSettings) -> str:
    """Phrase for a failed run: the step of its checkpoint, if it has left one."""
    from metagcttt_core.training.checkpoint import steps_done

    step = steps_done(settings.checkpoint_folder)
    return f'the checkpoint of step {step} is whole' if step else 'there is no checkpoint yet'


@contextmanager
def process_group(device: str) -> Iterator[None]:
    """Connects the processes that `torchrun` started; without it there is nothing to connect."""
    import torch
    from torch import distributed
    from torch.distributed.distributed_c10d import PrefixStore
    from torch.distributed.rendezvous import rendezvous

    if not distributed.is_torchelastic_launched():
        yield
        return
    if device == 'cuda':
        torch.cuda.set_device(int(os.environ['LOCAL_RANK']))
    store, rank, size = next(iter(rendezvous('env://')))
    if os.environ['LOCAL_WORLD_SIZE'] == os.environ['WORLD_SIZE']:
        # torchrun's store keeps the addresses of killed processes (pytorch #135712); between
        # machines the count of restarts differs.
        store = PrefixStore(os.environ['TORCHELASTIC_RESTART_COUNT'], store)
    backend = 'gloo' if device == 'cpu' else 'nccl'
    distributed.init_process_group(backend, store=store, rank=rank, world_size=size)
    try:
        yield
    finally:
        distributed.destroy_process_group()


def history_entry(
    stage: str,
    settings: RunSettings,
    decisive: dict[str, Any],
    made_from: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The record of a run in the history of the policy that comes of it.

    Args:
        stage: `pretrain` or `post_train`.
        settings: Of the program.
        decisive: Everything that decides the result; see `TrainingRun`.
        made_from: What the dataset was made from, if it says so.
    """
    steps = {name: leaves(settings)[name] for name in settings.may_grow}
    origin = {'made_from': made_from} if made_from else {}
    return {'stage': stage, **nested(decisive | steps), **origin, **provenance()}


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
    versions = {name: version(name) for name in _PACKAGES if find_spec(name)}
    return {'commit': commit, 'versions': versions}


def write_settings(folder: Path, settings: Settings) -> None:
    """The resolved settings, beside a run's results."""
    record = {'settings': settings.model_dump(mode='json'), **provenance()}
    write_json(folder / SETTINGS, record)


def use_threads(count: int) -> None:
    """Threads for tensor operations; results are repeatable for an equal count."""
    import torch

    torch.set_num_threads(count)
