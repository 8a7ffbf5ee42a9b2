"""Robots of any kind: a contract says what to read from a robot's topics and what to write."""

from metagcttt_core.data.identity import identity_fault
from metagcttt_core.robot.contract import Contract
from metagcttt_core.robot.errors import ContractError, MessageError
from metagcttt_core.robot.observer import Observer
from metagcttt_core.robot.yaml_file import load_contract

__all__ = [
    'Contract',
    'ContractError',
    'MessageError',
    'Observer',
    'identity_fault',
    'load_contract',
]
