"""Contracts in YAML files."""

from pathlib import Path

from metagcttt_core.config.yaml_file import load_yaml, SettingsFileError
from metagcttt_core.robot.contract import Contract
from metagcttt_core.robot.errors import ContractError


def load_contract(path: str | Path) -> Contract:
    """The contract in a YAML file.

    Raises:
        ContractError: If the file cannot be read or the contract is wrong; a line for each
            mistake, with file, line, setting, what was got and what is accepted.
    """
    try:
        return load_yaml(path, Contract)
    except SettingsFileError as error:
        raise ContractError(str(error)) from error
