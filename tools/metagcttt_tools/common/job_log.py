"""Results of many small jobs, kept as they finish so that a program can be resumed."""

import json
from pathlib import Path
from typing import Any, cast, Generic, TypeVar

from metagcttt_core.config import error_lines
from metagcttt_core.files import read_json_lines, write_text
from pydantic import BaseModel, ValidationError


class _Entry(BaseModel):
    job: tuple[str | int | float, ...]
    result: float | tuple[float, ...]


Job = TypeVar('Job', bound=tuple[Any, ...])


class JobLog(Generic[Job]):
    """A JSON-lines file of finished jobs; the first line holds the settings that decide them."""

    def __init__(self, path: Path, settings: dict[str, Any], *, resume: bool) -> None:
        """Open the log.

        Args:
            path: The file; its folder is made if missing.
            settings: `decisive`, what decides the results, and whatever else to keep.
            resume: Keep what an earlier call for the same settings finished.

        Raises:
            ValueError: If the file is of other settings; names the first that differs. Without
                `resume`, if it is there.
        """
        self._path = path
        self.finished: dict[Job, Any] = {}
        if path.exists():
            self.settings(path)  # or it is none of ours
            if not resume and len(read_json_lines(path)) > 1:
                raise ValueError(
                    f'{path}: holds what an interrupted call finished: pass --resume to continue, '
                    'remove it to start anew, or choose another --out'
                )
            if resume:
                self._read(settings)
        lines: list[dict[str, Any]] = [{'settings': settings}]
        lines += [{'job': job, 'result': result} for job, result in self.finished.items()]
        write_text(path, ''.join(map(_line, lines)))  # whole, and without a line cut short
        self._file = path.open('a', encoding='utf-8')

    def add(self, job: Job, result: float | tuple[float, ...]) -> None:
        """Keep the result of a job."""
        self.finished[job] = result
        self._file.write(_line({'job': job, 'result': result}))
        self._file.flush()

    def close(self) -> None:
        """Close the file, which is to be deleted once the results are kept elsewhere."""
        self._file.close()

    @staticmethod
    def settings(path: Path) -> dict[str, Any]:
        """The settings that the log in `path` begins with.

        Raises:
            ValueError: If it does not; names the file.
        """
        first, *_ = read_json_lines(path) or [{}]
        settings = first.get('settings')
        if not isinstance(settings, dict) or not isinstance(settings.get('decisive'), dict):
            raise ValueError(f'{path}: does not begin with settings: remove it to start anew')
        return settings

    def _read(self, settings: dict[str, Any]) -> None:
        kept, asked = self.settings(self._path)['decisive'], settings['decisive']
        for name in sorted(kept.keys() | asked.keys()):
            if kept.get(name) != asked.get(name):
                raise ValueError(
                    f'{self._path}: cannot resume, {name} was {kept.get(name)!r} '
                    f'and is now {asked.get(name)!r}'
                )
        for number, line in enumerate(read_json_lines(self._path)[1:], 2):
            try:
                entry = _Entry.model_validate(line)
            except ValidationError as error:
                lines = '; '.join(error_lines(error))
                raise ValueError(f'{self._path}:{number}: {lines}') from error
            self.finished[cast(Job, entry.job)] = entry.result


def _line(entry: dict[str, Any]) -> str:
    return json.dumps(entry) + '\n'
