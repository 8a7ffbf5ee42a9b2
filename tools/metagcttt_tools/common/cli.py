"""Command lines from typed settings: defaults, then a preset, then flags."""

from collections.abc import Callable, Collection, Sequence
from contextvars import ContextVar
import os
import re
import sys
from typing import Annotated, Any, NoReturn, TypeVar

from metagcttt_core.config import error_lines, Settings
from metagcttt_core.config.settings import nearest_name
from pydantic import BaseModel, ValidationError
import tyro

from metagcttt_tools.common.presets import load_preset, presets_with
from metagcttt_tools.common.resume import continued, Resumable

SettingsT = TypeVar('SettingsT', bound=Settings)


_only_asked: ContextVar[bool] = ContextVar('_only_asked', default=False)


class _Preset(BaseModel):
    preset: Annotated[str | None, tyro.conf.arg(help='')] = None


class _Asked(BaseException):
    """Ends a program where it asks for its settings."""

    def __init__(self, model: type[Settings]) -> None:
        self.model = model


def parse(
    model: type[SettingsT],
    description: str,
    program: str,
    argv: Sequence[str] | None = None,
    *,
    section: str | None = None,
) -> SettingsT:
    """The settings of one program, read from the command line.

    `--preset NAME_OR_PATH` loads the values under `section` of a preset first; flags override
    them. `--resume` takes the settings kept with the run in OUT instead.

    Args:
        model: The program's settings.
        description: What the program does, with an example; opens the help page.
        program: Its subcommand, such as `meta-train` or `benchmark sim`.
        argv: Arguments; those of the process by default.
        section: Key of the program's values in a preset file; by default the subcommand with
            underscores.

    Returns:
        The validated settings. A wrong value ends the process with status 2 and a line that names
        it.
    """
    if _only_asked.get():
        raise _Asked(model)
    section = section or re.sub(r'\W', '_', program)
    arguments = list(sys.argv[1:] if argv is None else argv)
    preset, rest = tyro.cli(_Preset, args=arguments, return_unknown_args=True, add_help=False)
    try:
        values = preset_values(preset.preset, section)
        description += _preset_help(section)

        def with_flags(default: SettingsT) -> SettingsT:
            return tyro.cli(
                model,
                args=rest,
                default=default,
                description=description,
                prog=f'metagcttt {program}',
            )

        try:
            default = model.model_validate(values)
        except ValidationError as error:
            fail(*(f'{_origin(preset.preset)}: {line}' for line in error_lines(error)))
        settings = with_flags(default)
        if isinstance(settings, Resumable) and settings.resume:
            return continued(settings, values, with_flags)  # type: ignore[arg-type]
        return settings
    except ValidationError as error:
        fail(*error_lines(error))
    except ValueError as error:
        fail(str(error))


def flags_of(main: Callable[[list[str]], None]) -> type[BaseModel]:
    """A model with every flag of a program, whose `main` starts by reading its settings."""
    token = _only_asked.set(True)
    try:
        main([])
    except _Asked as asked:
        return type(asked.model.__name__, (asked.model, _Preset), {'__doc__': ''})
    finally:
        _only_asked.reset(token)
    raise AssertionError(f'{main.__module__} read no settings')


def _origin(preset: str | None) -> str:
    """Where values that no flag gave come from."""
    overrides = os.environ.get('METAGCTTT_OVERRIDES')
    return ' with '.join(f'preset {name}' for name in (preset, overrides) if name)


def check_sections(arguments: Sequence[str], sections: Collection[str]) -> None:
    """End the process if a preset that is named has a section that is of no program.

    Args:
        arguments: Of the program.
        sections: Of all programs.
    """
    known, _ = tyro.cli(_Preset, args=arguments, return_unknown_args=True, add_help=False)
    for name in (known.preset, os.environ.get('METAGCTTT_OVERRIDES')):
        try:
            preset = load_preset(name) if name else {}
        except ValueError as error:
            fail(str(error))
        for section in preset:
            if section not in sections:
                near = nearest_name(str(section), sections)
                hint = f'; did you mean {near!r}?' if near else ''
                fail(f'preset {name}: {section!r} is a section of no program{hint}')


def _preset_help(section: str) -> str:
    """Name the presets that a program can start from; nothing for a program without any."""
    names = presets_with(section)
    if not names:
        return ''
    listed = [name for name in names if not name.startswith('paper-')]
    if len(listed) < len(names):
        listed.append("one of the paper's (metagcttt presets)")
    return f'\n\n--preset NAME_OR_PATH starts from a preset: {", ".join(listed)}.'


def preset_values(name: str | None, section: str) -> dict[str, Any]:
    """The values for one program in a preset, with those of METAGCTTT_OVERRIDES over them.

    Args:
        name: Name or path of the preset; without one there are no values but the overrides.
        section: Key of the program's values.

    Raises:
        ValueError: If there is no such preset, or no such section in the one that is named.
    """
    values = {} if name is None else _section(name, section)
    overrides = os.environ.get('METAGCTTT_OVERRIDES')
    if overrides and section in load_preset(overrides):
        values = merged(values, _section(overrides, section))
    return values


def _section(name: str, section: str) -> dict[str, Any]:
    preset = load_preset(name)
    if section not in preset:
        raise ValueError(f'preset {name} has no section {section!r}; it has: {", ".join(preset)}')
    if not isinstance(preset[section], dict):
        raise ValueError(
            f'preset {name}: {section} must hold a mapping of settings, '
            f'got {type(preset[section]).__name__}'
        )
    return preset[section]


def merged(values: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    """`values` with `overrides` in their place; mappings are merged key by key."""
    return values | {
        key: merged(values[key], value)
        if isinstance(value, dict) and isinstance(values.get(key), dict)
        else value
        for key, value in overrides.items()
    }


def fail(*lines: str) -> NoReturn:
    """End the process with status 2 after printing each line to standard error."""
    for line in lines:
        print(f'error: {line}', file=sys.stderr)
    raise SystemExit(2)
