"""Which simulator a policy is for."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from metagcttt_core import Agent


def environment_of(agent: Agent) -> str:
    """The name of the simulator that a policy is for.

    Raises:
        CheckpointError: If it does not say so, as that of a robot.
    """
    from metagcttt_core import CheckpointError

    if environment := agent.metadata.get('environment'):
        return str(environment)
    if contract := agent.metadata.get('contract'):
        raise CheckpointError(
            f'{agent.origin}: is of the robot {contract["robot"]}, not of a maze; metagcttt '
            'evaluate-robot and evaluate --offline take it'
        )
    raise CheckpointError(f'{agent.origin}: does not say which environment it is for')
