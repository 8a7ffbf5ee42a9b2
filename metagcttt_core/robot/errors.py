"""Errors of contracts and of the messages that they are about."""


class ContractError(ValueError):
    """A contract that cannot be used; each line of the message names file, line and setting."""


class MessageError(ValueError):
    """A message that does not satisfy the contract, and why."""
