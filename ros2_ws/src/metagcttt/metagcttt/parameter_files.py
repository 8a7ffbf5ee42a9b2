"""Parameter files of the command line that say nothing to the node they are given to."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
import re
from typing import Any

from rclpy.node import Node
import yaml

_PARAMETERS = 'ros__parameters'


def warn_of_unused_files(node: Node, argv: Sequence[str]) -> None:
    """Warn of every parameter file none of whose sections is for the node.

    rcl passes over such a file without a word, and the node runs on its defaults.

    Args:
        node: The node.
        argv: The arguments of its process, which rcl has accepted.
    """
    name = node.get_fully_qualified_name()
    for flag, file in pairwise(argv):
        if flag != '--params-file':
            continue
        sections = list(_sections(yaml.safe_load(Path(file).read_text(encoding='utf-8'))))
        if not any(_is_for(section, name) for section in sections):
            named = ', '.join(sections) or 'no node'
            node.get_logger().warning(
                f'{file} is ignored: it has parameters of {named}, and this is {name}'
            )


def _sections(content: Any, above: str = '') -> Iterator[str]:
    """The names of nodes in a parameter file, with their namespaces."""
    if not isinstance(content, dict):
        return
    for key, inner in content.items():
        if key == _PARAMETERS:
            yield above
        else:
            yield from _sections(inner, f'{above}/{str(key).strip("/")}')


def _is_for(section: str, node: str) -> bool:
    """Whether rcl takes a section for the node: * is any name, ** any number of them."""
    parts = [
        '(/[^/]+)*' if part == '**' else '/' + re.escape(part).replace(r'\*', '[^/]*')
        for part in section.strip('/').split('/')
    ]
    return re.fullmatch(''.join(parts), node) is not None
