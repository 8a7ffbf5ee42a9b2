"""The log of a run: TensorBoard and `metrics.jsonl`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
import json
from pathlib import Path
import sys
import time
from typing import Any, Self, TYPE_CHECKING

from metagcttt_core.files import atomic_write, read_json_lines
import numpy as np

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

METRICS = 'metrics.jsonl'


class RunLog:
    """Numbers of a run, to TensorBoard and to the JSON-lines file `metrics.jsonl`.

    Attributes:
        records: The lines logged so far by a resumed run.
    """

    def __init__(self, folder: Path, first_step: int) -> None:
        """Open the logs in `folder`; lines of a resumed run beyond `first_step` are dropped."""
        path = folder / METRICS
        self.records: list[dict[str, Any]] = []
        if first_step > 0 and path.exists():
            self.records = [line for line in read_json_lines(path) if line['step'] <= first_step]
        with atomic_write(path) as file:
            file.writelines((json.dumps(record) + '\n').encode() for record in self.records)
        self._file = path.open('a', encoding='utf-8')
        self._writer = _tensorboard(folder / 'tensorboard', first_step)

    def write(
        self,
        step: int,
        scalars: Mapping[str, float | None],
        *,
        samples: Mapping[str, Sequence[float]] | None = None,
        curves: Mapping[str, Sequence[float]] | None = None,
        warnings: Sequence[str] = (),
    ) -> None:
        """Record a step.

        Args:
            step: Steps done.
            scalars: Numbers by name; those that are None are left out.
            samples: Values to see the distribution of, by name.
            curves: Values in their order, by name; to the file only, with six digits.
            warnings: What looks bad.
        """
        known = {name: value for name, value in scalars.items() if value is not None}
        record = {'step': step, 'time': round(time.time(), 3), **known, **(samples or {})}
        for name, values in (curves or {}).items():
            record[name] = [float(f'{value:.6g}') for value in values]
        if warnings:
            record['warnings'] = list(warnings)
        self._file.write(json.dumps(record) + '\n')
        self._file.flush()
        if self._writer is None:
            return
        for name, value in known.items():
            self._writer.add_scalar(name, value, step)
        for name, values in (samples or {}).items():
            self._writer.add_histogram(name, np.asarray(values), step)
        for warning in warnings:
            self._writer.add_text('warnings', warning, step)

    def close(self) -> None:
        """Flush and close."""
        self._file.close()
        if self._writer is not None:
            self._writer.close()

    def __enter__(self) -> Self:
        """The log itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


class SilentLog(RunLog):
    """The log of a process that leaves writing to another."""

    def __init__(self) -> None:
        """Open nothing."""
        self.records = []

    def write(self, *_: Any, **__: Any) -> None:
        """Record nothing."""

    def close(self) -> None:
        """Do nothing: no file is open."""


def _tensorboard(folder: Path, first_step: int) -> SummaryWriter | None:
    """The logs in `folder`; none, and a line that says so, where TensorBoard is not installed."""
    if find_spec('tensorboard') is None:
        print('no TensorBoard logs: pip install "metagcttt-core[plots]"', file=sys.stderr)
        return None
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=first_step)


def last_step(folder: Path) -> int:
    """The step of the last line that the run in `folder` has logged; 0 before the first."""
    path = folder / METRICS
    if not path.exists():
        return 0
    with path.open('rb') as file:
        file.seek(max(0, path.stat().st_size - 2**16))
        lines = file.read().split(b'\n')[:-1]
    return int(json.loads(lines[-1])['step']) if lines else 0
