"""YAML files from outside: a mapping of settings, or one error that names file and line."""

from collections.abc import Iterator
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import yaml

_MOST_NODES = 100_000
"""A file of settings has hundreds; anchors that refer to anchors make billions of a few lines."""


class YamlError(ValueError):
    """A file that is no mapping of settings; each line of the message names file and line."""


def read_yaml(path: Path | Traversable) -> tuple[yaml.MappingNode, dict[str, Any]]:
    """The settings in a file, as nodes, which know their lines, and as values.

    Raises:
        YamlError: If it cannot be read, is not valid YAML or no mapping, gives a key twice, or
            its anchors multiply beyond any settings.
    """
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise YamlError(f'{path}: cannot be read ({error})') from error
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        if not isinstance(root, yaml.MappingNode):
            raise YamlError(f'{path}:1: must hold a mapping of settings')
        if _size(root, {}) > _MOST_NODES:
            raise YamlError(f'{path}: its anchors refer to themselves, or to more than fits')
        repeated = [f'{path}:{line}: {key} is given twice' for key, line in _repeated_keys(root)]
        if repeated:
            raise YamlError('\n'.join(repeated))
        return root, yaml.SafeLoader(text).construct_document(root)
    except (yaml.YAMLError, RecursionError) as error:  # an unknown tag, a key that cannot be one
        raise YamlError(_fault(path, error)) from error
    except ValueError as error:
        if isinstance(error, YamlError):
            raise
        raise YamlError(_fault(path, error)) from error  # a date that no calendar has


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
