"""ROS executables as child processes that cannot outlive their owner."""

from collections.abc import Mapping
import os
from pathlib import Path
import signal
import subprocess
from typing import Self

from metagcttt_core.files import open_log

_ROS2RUN = Path(__file__).parents[2] / 'ros2run'
# Also when the owner is killed.
_ENDS_WITH_ITS_OWNER = ('setpriv', '--pdeathsig', 'TERM')
_LOG_LINES = 30


class NodeFailedError(RuntimeError):
    """A node process ended by itself; the message has the end of its log."""


class NodeProcess:
    """One ROS executable, its output kept in a log file."""

    def __init__(
        self,
        executable: str,
        parameters: Mapping[str, bool | int | float | str],
        log: Path,
        environment: Mapping[str, str] | None = None,
        remappings: Mapping[str, str] | None = None,
        package: str = 'metagcttt',
    ) -> None:
        """Start it.

        Args:
            executable: Such as `policy_node`.
            parameters: ROS parameters by name.
            log: File for what it prints.
            environment: Environment variables besides those of this process.
            remappings: Names to replace, such as `/clock`; `__ns` sets the namespace.
            package: The ROS package that has it.

        Raises:
            FileExistsError: If there is a file in the place of the log that is none of ours.
        """
        self.executable = executable
        self.log = log
        command = [*_ENDS_WITH_ITS_OWNER, str(_ROS2RUN), package, executable, '--ros-args']
        for name, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ['-p', f'{name}:={text}']
        for name, other in (remappings or {}).items():
            command += ['-r', f'{name}:={other}']
        with open_log(log, executable, anew=True) as output:
            self._process = subprocess.Popen(
                command,
                stdout=output,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env={**os.environ, **(environment or {})},
                start_new_session=True,  # its own process group, so that all of it can be ended
            )

    def check(self) -> None:
        """Raise if it has ended.

        Raises:
            NodeFailedError: With its exit status and the end of its log.
        """
        status = self._process.poll()
        if status is not None:
            raise NodeFailedError(self.describe(f'ended with status {status}'))

    def describe(self, problem: str) -> str:
        """The problem and the end of the log, for a person to read."""
        lines = self.log.read_text(encoding='utf-8', errors='replace').splitlines()[-_LOG_LINES:]
        return f'{self.executable} {problem}; the end of {self.log}:\n  ' + '\n  '.join(lines)

    def stop(self, timeout_s: float = 20.0, signal_number: int = signal.SIGINT) -> int:
        """End it, as Ctrl-C would, by force after `timeout_s`; returns its exit status."""
        for number in (signal_number, signal.SIGKILL):
            if self._process.poll() is None:
                os.killpg(self._process.pid, number)
            try:
                return self._process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                continue
        raise NodeFailedError(self.describe('cannot be killed'))

    def kill(self) -> None:
        """End it at once, as a crash would."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def __enter__(self) -> Self:
        """The running process."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop it."""
        self.stop()
