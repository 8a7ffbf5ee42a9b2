"""The agents by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TYPE_CHECKING

from metagcttt_core.plugins import PluginError, Registry

if TYPE_CHECKING:
    from metagcttt_core.agents.agent import Agent

AGENTS: Registry[type[Agent]] = Registry(
    'metagcttt.agents',
    'agent',
    {
        'crl': 'metagcttt_core.agents.crl:CRL',
        'gcbc': 'metagcttt_core.agents.gcbc:GCBC',
        'gciql': 'metagcttt_core.agents.gciql:GCIQL',
        'saw': 'metagcttt_core.agents.saw:SAW',
    },
)


def make_agent(
    name: str,
    *,
    obs_dim: int,
    act_dim: int,
    hidden: Sequence[int] = (512, 512, 512),
    seed: int = 0,
    **settings: Any,
) -> Agent:
    """A freshly initialised agent.

    Args:
        name: A key of `AGENTS`.
        obs_dim: Width of an observation, which is also that of a goal.
        act_dim: Width of an action.
        hidden: Units of each hidden layer.
        seed: Of the initial weights.
        settings: Further settings of that agent.

    Raises:
        ValueError: For an unknown agent or setting, or a value out of range.
        PluginError: If it is another package's and cannot be loaded, or has another name there.
    """
    import torch

    agent_type = AGENTS.find(name)
    if agent_type.name != name:  # by which its checkpoints are loaded
        raise PluginError(f'agent {name!r} must have that name, its own is {agent_type.name!r}')
    checked = agent_type.settings_type(hidden=tuple(hidden), **settings)
    return agent_type(obs_dim, act_dim, checked, torch.Generator().manual_seed(seed))
