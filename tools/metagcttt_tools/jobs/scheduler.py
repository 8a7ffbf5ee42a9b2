"""Where the runs of a study run: one interface, this machine, and all runs in one view."""

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
import threading
from typing import Protocol

from metagcttt_core.config import Settings
from pydantic import Field
from tqdm import tqdm

from metagcttt_tools.common.stopping import Stop
from metagcttt_tools.jobs.program import (
    Invocation,
    JobError,
    JobLostError,
    JobStoppedError,
    run_program,
)


class Resources(Settings):
    """What a run may count on."""

    gpus: float = Field(1.0, ge=0, description='GPUs of a training on cuda; 0.5 shares one')
    memory_gib: float = Field(
        0.0, ge=0, description='memory of a run in GiB, on a cluster; 0 reserves none'
    )
    retries: int = Field(
        20, ge=0, description='times that a run begins again after it was killed or pre-empted'
    )


@dataclass(frozen=True)
class Job:
    """A run of a program.

    Attributes:
        invocation: The program and its settings.
        size: Steps of the whole run.
        done: How many of them are done.
        cpus: Processor cores that it keeps busy.
        gpu: Whether it computes on a GPU.
    """

    invocation: Invocation
    size: int
    done: Callable[[], int]
    cpus: int = 1
    gpu: bool = False


class Scheduler(Protocol):
    """Runs jobs somewhere, and again when they are killed."""

    def submit(self, job: Job) -> Future[None]:
        """Queue a job; its future raises `JobError` or `JobStoppedError`."""

    def stop(self) -> None:
        """Make running jobs save and end, and start no more."""


class LocalScheduler:
    """Runs jobs on this machine, as many at the same time as there are cores for."""

    def __init__(self, cores: int, retries: int) -> None:
        """Start nothing yet."""
        self._cores = self._free = cores
        self._retries = retries
        self._pool = ThreadPoolExecutor(cores)
        self._change = threading.Condition()
        self._stopped = threading.Event()

    def submit(self, job: Job) -> Future[None]:
        """Queue a job."""
        return self._pool.submit(self._run, job)

    def stop(self) -> None:
        """Make running jobs save and end, and start no more."""
        self._stopped.set()

    def _run(self, job: Job) -> None:
        cores = min(job.cpus, self._cores)
        with self._change:
            self._change.wait_for(lambda: self._free >= cores)
            self._free -= cores
        try:
            self._attempts(job.invocation)
        finally:
            with self._change:
                self._free += cores
                self._change.notify_all()

    def _attempts(self, invocation: Invocation) -> None:
        for attempt in range(self._retries + 1):
            if self._stopped.is_set():
                raise JobStoppedError(invocation.program)
            try:
                return run_program(invocation, self._stopped.is_set)
            except JobLostError as error:
                if attempt == self._retries:
                    raise JobError(f'{error}, for the last of {attempt + 1} times') from error


def run_all(name: str, jobs: Sequence[Job], scheduler: Scheduler, stop: Stop) -> None:
    """Run jobs to their end, with their steps on one progress bar.

    The first failure makes the others save and end.

    Raises:
        KeyboardInterrupt: If `stop` was set; the runs have saved what they did.
        JobError: If a run failed.
        JobStoppedError: If somebody else stopped a run.
    """
    futures = {scheduler.submit(job): job for job in jobs}
    pending = set(futures)
    ended: list[Job] = []
    failure = None
    with tqdm(total=sum(job.size for job in jobs), unit='step', desc=name) as bar:
        while pending:
            done, pending = wait(pending, timeout=0.5, return_when=FIRST_COMPLETED)
            for future in done:
                error = future.exception()
                asked = failure is not None or stop.is_set()
                if error is None:
                    ended.append(futures[future])
                elif not (asked and isinstance(error, JobStoppedError)):
                    failure = failure or error
            if failure is not None or stop.is_set():
                scheduler.stop()
            steps = sum(job.size for job in ended)
            steps += sum(futures[future].done() for future in pending)
            bar.set_postfix_str(f'{len(ended)} of {len(jobs)} runs done', refresh=False)
            if steps != bar.n or done:
                bar.update(steps - bar.n)
    if failure is not None:
        raise failure
    if stop.is_set():
        raise KeyboardInterrupt
