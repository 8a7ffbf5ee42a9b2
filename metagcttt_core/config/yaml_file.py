"""YAML files from outside: a mapping of settings, or one error that names file and line."""

from collections.abc import Iterator, Sequence
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError
import yaml

from metagcttt_core.config.settings import error_line, Settings, UnknownSettingError

SettingsT = TypeVar('SettingsT', bound=Settings)

_MOST_BYTES = 1 << 17
"""A file of settings has thousands; a larger one is something else and takes minutes to parse."""
_MOST_NODES = 100_000
"""A file of settings has hundreds; anchors that refer to anchors make billions of a few lines."""


class SettingsFileError(ValueError):
    """A file of settings that cannot be used; a line for each mistake names file and line."""


def load_yaml(path: str | Path, model: type[SettingsT]) -> SettingsT:
    """The settings in a YAML file.

    Args:
        path: The file.
        model: Their type.

    Raises:
        SettingsFileError: If the file cannot be read or the settings are wrong; a line for each
            mistake, with file, line, setting, what was got and what is accepted.
    """
    root, values = read_yaml(Path(path))
    try:
        return model.model_validate(values)
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


def read_yaml(path: Path | Traversable) -> tuple[yaml.MappingNode, dict[str, Any]]:
    """The settings in a file, as nodes, which know their lines, and as values.

    Raises:
        SettingsFileError: If it cannot be read, is not valid YAML or no mapping, gives a key
            twice, or its anchors multiply beyond any settings.
    """
    try:
        with path.open('rb') as file:
            content = file.read(_MOST_BYTES + 1)
        text = content.decode()
    except (OSError, ValueError) as error:
        raise SettingsFileError(f'{path}: cannot be read ({error})') from error
    if len(content) > _MOST_BYTES:
        raise SettingsFileError(f'{path}: is no file of settings, it has over {_MOST_BYTES} bytes')
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        if not isinstance(root, yaml.MappingNode):
            raise SettingsFileError(f'{path}:1: must hold a mapping of settings')
        if _size(root, {}) > _MOST_NODES:
            raise SettingsFileError(
                f'{path}: its anchors refer to themselves, or to more than fits'
            )
        repeated = [f'{path}:{line}: {key} is given twice' for key, line in _repeated_keys(root)]
        if repeated:
            raise SettingsFileError('\n'.join(repeated))
        return root, yaml.SafeLoader(text).construct_document(root)
    except (yaml.YAMLError, RecursionError) as error:  # an unknown tag, a key that cannot be one
        raise SettingsFileError(_fault(path, error)) from error
    except ValueError as error:
        if isinstance(error, SettingsFileError):
            raise
        raise SettingsFileError(_fault(path, error)) from error  # a date that no calendar has


def _fault(path: Path | Traversable, error: Exception) -> str:
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark:
        return f'{path}:{error.problem_mark.line + 1}: not valid YAML: {error.problem}'
    return f'{path}: not valid YAML: {error}'


def _size(node: yaml.Node, sizes: dict[int, int]) -> int:
    """Nodes below and with this one, each as often as anchors repeat it."""
    if id(node) not in sizes:
        sizes[id(node)] = _MOST_NODES + 1  # while it is counted: it contains itself
        children = [] if isinstance(node, yaml.ScalarNode) else node.value
        if isinstance(node, yaml.MappingNode):
            children = [part for pair in node.value for part in pair]
        sizes[id(node)] = 1 + sum(_size(child, sizes) for child in children)
    return sizes[id(node)]


def _repeated_keys(node: yaml.Node) -> Iterator[tuple[str, int]]:
    if isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            if str(key.value) in seen:
                yield str(key.value), key.start_mark.line + 1
            seen.add(str(key.value))
            yield from _repeated_keys(value)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            yield from _repeated_keys(item)


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
