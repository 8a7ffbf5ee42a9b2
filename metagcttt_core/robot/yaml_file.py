"""Contracts in YAML files, whose mistakes are named with their lines."""

from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError
import yaml

from metagcttt_core.config.settings import error_line, UnknownSettingError
from metagcttt_core.config.yaml_file import read_yaml, YamlError
from metagcttt_core.robot.contract import Contract
from metagcttt_core.robot.errors import ContractError


def load_contract(path: str | Path) -> Contract:
    """The contract in a YAML file.

    Raises:
        ContractError: If the file cannot be read or the contract is wrong; a line for each
            mistake, with file, line, setting, what was got and what is accepted.
    """
    path = Path(path)
    try:
        root, values = read_yaml(path)
        return Contract.model_validate(values)
    except YamlError as error:
        raise ContractError(str(error)) from error
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
        raise ContractError('\n'.join(lines)) from error


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
