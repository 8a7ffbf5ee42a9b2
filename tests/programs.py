"""Programs of the project in processes of their own that need not import PyTorch again."""

from collections.abc import Mapping, Sequence
import multiprocessing
from multiprocessing.process import BaseProcess
import os
from pathlib import Path
import signal
import sys
import tempfile
from typing import NamedTuple

from metagcttt_tools.main import main

# A server imports the heaviest of what programs import late; each program is a fork of it.
_FORKS = multiprocessing.get_context('forkserver')
_FORKS.set_forkserver_preload(
    ['torch._dynamo', 'metagcttt_tools.common.plots', 'sim_bridge.generation', 'ogbench.locomaze']
)


class Ended(NamedTuple):
    """How a program ended, and all that it printed."""

    returncode: int
    output: str


def metagcttt(arguments: Sequence[str], cwd: Path, environment: Mapping[str, str]) -> Ended:
    """Run `metagcttt` in a folder, with these variables of the environment, to its end."""
    with tempfile.NamedTemporaryFile(mode='w+', encoding='utf-8') as output:
        process = start(arguments, cwd, environment, Path(output.name))
        process.join()
        assert process.exitcode is not None
        return Ended(process.exitcode, output.read())


def start(
    arguments: Sequence[str], cwd: Path, environment: Mapping[str, str], output: Path
) -> BaseProcess:
    """Start `metagcttt` in a folder, with these variables; what it prints goes into a file."""
    process = _FORKS.Process(target=_run, args=(list(arguments), cwd, dict(environment), output))
    process.start()
    return process


def _run(arguments: list[str], cwd: Path, environment: dict[str, str], output: Path) -> None:
    # A server may have been started with it ignored, as background jobs are.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    file = os.open(output, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    os.dup2(file, 1)
    os.dup2(file, 2)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:0] = filter(None, environment.get('PYTHONPATH', '').split(os.pathsep))
    sys.argv = ['metagcttt', *arguments]
    main(arguments)
