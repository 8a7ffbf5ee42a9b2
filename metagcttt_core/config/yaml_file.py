"""Settings in YAML files, whose mistakes are named with their lines."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError
import yaml

from metagcttt_core.config.settings import error_line, Settings, UnknownSettingError

SettingsT = TypeVar('SettingsT', bound=Settings)


class SettingsFileError(ValueError):
    """A file of settings that cannot be used; a line for each mistake."""


def load_yaml(path: str | Path, model: type[SettingsT], what: str) -> SettingsT:
    """The settings in a YAML file.

    Args:
        path: The file.
        model: Their type.
        what: What they are, for messages: `a contract`.

    Raises:
        SettingsFileError: If the file cannot be read or the settings are wrong; a line for each
            mistake, with file, line, setting, what was got and what is accepted.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding='utf-8')
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsFileError(f'{path}: cannot be read ({error})') from error
    except yaml.YAMLError as error:
        raise SettingsFileError(_yaml_fault(path, error)) from error
    if not isinstance(root, yaml.MappingNode):
        raise SettingsFileError(f'{path}:1: {what} is a mapping of settings')
    if repeated := [f'{path}:{line}: {key} is given twice' for key, line in _repeated_keys(root)]:
        raise SettingsFileError('\n'.join(repeated))
    try:
        return model.model_validate(yaml.SafeLoader(text).construct_document(root))
    except yaml.YAMLError as error:  # a key that cannot be one, an unknown tag
        raise SettingsFileError(_yaml_fault(path, error)) from error
    except ValidationError as error:
        lines = []
        for problem in error.errors():
            if problem['type'] == 'too_short' and problem['input']:
                continue  # counts without the items that are wrong, which have lines of their own
            location = list(problem['loc'])
            cause = problem.get('ctx', {}).get('error')
            if isinstance(cause, UnknownSettingError):
                location.append(cause.key)
            lines.append(f'{path}:{_line_of(root, location)}: {error_line(problem)}')
        raise SettingsFileError('\n'.join(lines)) from error


def _yaml_fault(path: Path, error: yaml.YAMLError) -> str:
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark:
        return f'{path}:{error.problem_mark.line + 1}: not valid YAML: {error.problem}'
    return f'{path}: not valid YAML: {error}'


def _line_of(node: yaml.Node, location: Sequence[str | int]) -> int:
    """The line of a setting, counted from 1; that of the innermost one that is in the file."""
    line = node.start_mark.line
    for part in location:
        if isinstance(node, yaml.MappingNode):
            found = [(key, value) for key, value in node.value if key.value == str(part)]
            if not found:
                break
            key, node = found[0]
            line = key.start_mark.line
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int):
            node = node.value[part]
            line = node.start_mark.line
    return line + 1


def _repeated_keys(node: yaml.Node) -> Iterator[tuple[str, int]]:
    if isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            if key.value in seen:
                yield key.value, key.start_mark.line + 1
            seen.add(key.value)
            yield from _repeated_keys(value)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            yield from _repeated_keys(item)
