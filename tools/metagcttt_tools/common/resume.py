"""Resuming: `--resume` alone continues a run by the settings that its folder keeps."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from metagcttt_core.config import error_lines, Settings
from metagcttt_core.files import read_json
from pydantic import Field, ValidationError


class Resumable(Settings):
    """Settings of a program that continues what an interrupted call left.

    A setting whose dotted name is in `may_change` does not decide the result and may differ when
    a run is resumed; a number of steps in `may_grow` may rise, which extends the run. A time limit
    is each call's own. All others are those of the interrupted call, and flags or presets that
    contradict them are refused.
    """

    may_change: ClassVar[frozenset[str]] = frozenset()
    may_grow: ClassVar[frozenset[str]] = frozenset()
    place: ClassVar[str] = 'out'
    """The setting that says where the results go."""

    resume: bool = Field(False, description='continue what an interrupted call left in OUT')

    def kept(self) -> tuple[Path, Mapping[str, Any]] | None:
        """The settings of the interrupted call and the file they are in; None if there is none."""
        return kept_in(getattr(self, self.place) / 'settings.json')

    def decisive(self) -> dict[str, Any]:
        """The settings that decide the result, for as many steps as there are, by dotted name."""
        free = {self.place, 'resume', *self.may_change, *self.may_grow}
        return {name: value for name, value in leaves(self).items() if name not in free}


def kept_in(file: Path) -> tuple[Path, Mapping[str, Any]] | None:
    """A JSON file and the settings in it; None if it does not exist.

    Raises:
        ValueError: If it holds something else.
    """
    if not file.is_file():
        return None
    try:
        settings = read_json(file)['settings']
    except (ValueError, KeyError) as error:
        raise ValueError(f'{file}: holds no settings to continue with ({error})') from error
    if not isinstance(settings, dict):
        raise ValueError(f'{file}: holds no settings to continue with (got {settings!r})')
    return file, settings


ResumableT = TypeVar('ResumableT', bound=Resumable)


def continued(
    given: ResumableT, preset: Mapping[str, Any], flags_over: Callable[[ResumableT], ResumableT]
) -> ResumableT:
    """The settings with which to continue a run.

    Args:
        given: What preset and flags say.
        preset: The values of the preset alone.
        flags_over: Applies the flags to other settings.

    Returns:
        The settings kept with the run, with what may change from preset and flags; `given` where
        there is no run yet.

    Raises:
        ValueError: If the preset or a flag contradicts a kept setting; names it and both values.
    """
    kept = given.kept()
    if kept is None:
        return given
    file, values = kept
    try:
        here = given.model_dump(include={given.place, 'resume', 'time_limit'})
        was = type(given).model_validate({**values, **here})
    except ValidationError as error:
        lines = '; '.join(error_lines(error))
        raise ValueError(f'{file}: is of another program or version: {lines}') from error
    old, asked, flagged = leaves(was), leaves(given), leaves(flags_over(was))
    named = {name for name in flagged if flagged[name] != old.get(name)}
    named |= {name for name in flat(preset) if asked.get(name) != old.get(name)}
    for name in sorted(named - {given.place, 'resume', *given.may_change}):
        if name not in given.may_grow:
            raise ValueError(
                f'{file}: cannot resume, {name} was {old.get(name)!r} and is now {asked[name]!r}'
            )
        if asked[name] < old[name]:
            raise ValueError(
                f'{file}: cannot resume, {name} was {old[name]} and is now {asked[name]}: '
                'a run can be extended, not shortened'
            )
    changes = {name: asked[name] for name in named}
    return type(given).model_validate(nested({**old, **changes}))


def leaves(settings: Settings) -> dict[str, Any]:
    """The single settings by dotted name, as JSON has them."""
    return flat(settings.model_dump(mode='json'))


def flat(values: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """The entries of nested mappings by dotted name."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            found |= flat(value, f'{prefix}{name}.')
        else:
            found[f'{prefix}{name}'] = value
    return found


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of `flat`."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        *path, last = name.split('.')
        inner = found
        for part in path:
            inner = inner.setdefault(part, {})
        inner[last] = value
    return found
