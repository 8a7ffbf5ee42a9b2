"""One run of a program as a process of its own."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time
from typing import NamedTuple

from filelock import FileLock, Timeout
from metagcttt_core.files import open_log

from metagcttt_tools.common.session import lock_of
from metagcttt_tools.common.stopping import REQUEUE

_LOCK_TIMEOUT_S = 60.0

ATTEMPT = '#'
"""What the line of a log begins with that an attempt begins with."""


class Invocation(NamedTuple):
    """A program with its settings.

    Attributes:
        program: Its subcommand.
        preset: A file with its settings; the log goes beside it.
        out: The folder or file of its results.
        cwd: The folder that relative paths start from.
    """

    program: str
    preset: Path
    out: Path
    cwd: Path

    @property
    def log(self) -> Path:
        """What it printed, in all its attempts."""
        return self.cwd / self.preset.with_suffix('.log')

    @property
    def command(self) -> list[str]:
        """Its command line."""
        program = [sys.executable, '-m', 'metagcttt_tools', self.program]
        return [*program, '--preset', str(self.preset)]


class JobError(ValueError):
    """A program failed; another attempt would fail as well."""


class JobLostError(Exception):
    """A program was killed or asked for another turn: the next attempt goes on from there."""


class JobStoppedError(JobError):
    """A program was told to stop, and saved what it did."""


def _await_end(process: subprocess.Popen[bytes]) -> None:
    """Wait until a program has saved, however often that is interrupted."""
    while process.returncode is None:
        with suppress(KeyboardInterrupt):
            process.wait()


def run_program(job: Invocation, stopped: Callable[[], bool] = lambda: False) -> None:
    """Run a program to its end.

    It is asked to save and end when this process dies, in whatever way. If an attempt before this
    one lives on, perhaps on another machine, its end is awaited.

    Args:
        job: The program.
        stopped: Asked all the while; once true, the program saves and ends. So it does on
            KeyboardInterrupt.

    Raises:
        JobError: If it failed; has its last line.
        JobLostError: If it was killed or pre-empted.
        JobStoppedError: If `stopped`, or on KeyboardInterrupt.
    """
    lock = lock_of(job.cwd / job.out)
    try:
        with FileLock(lock, timeout=_LOCK_TIMEOUT_S):
            pass
    except Timeout as error:
        raise JobError(f'{lock}: is held by another process for {_LOCK_TIMEOUT_S:g} s') from error
    # The kernel sends the signal; a process that nobody waits for must not train on.
    leash = ['setpriv', '--pdeathsig', 'TERM', '--'] if shutil.which('setpriv') else []
    try:
        log = open_log(job.log, job.program)
    except FileExistsError as error:
        raise JobError(str(error)) from error
    with log:
        process = subprocess.Popen(
            [*leash, *job.command],
            cwd=job.cwd,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        was_stopped = False
        try:
            while process.poll() is None:
                time.sleep(0.1)
                was_stopped = stopped()
                if was_stopped:
                    break
        except KeyboardInterrupt:
            was_stopped = True
        if was_stopped:
            # Ray blocks SIGINT, and shells ignore it in the background; programs inherit both.
            process.send_signal(signal.SIGTERM)
            _await_end(process)
            raise JobStoppedError(f'{" ".join(job.command)} was told to stop')
    if process.returncode == 0:
        return
    ended = f'{" ".join(job.command)} ended with status {process.returncode}'
    if process.returncode == REQUEUE or process.returncode < 0:
        raise JobLostError(ended)
    last = job.log.read_text(encoding='utf-8').rstrip().splitlines()[-1:]
    raise JobError(f'{ended}: {"".join(last)}')
