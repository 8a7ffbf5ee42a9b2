"""The agents by name."""

from collections.abc import Sequence
from typing import Any

import torch

from metagcttt_core.agents.agent import Agent
from metagcttt_core.agents.gcbc import GCBC
from metagcttt_core.agents.gciql import GCIQL

AGENTS: dict[str, type[Agent]] = {agent.name: agent for agent in (GCBC, GCIQL)}


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
    """
    if name not in AGENTS:
        raise ValueError(f'unknown agent {name!r}; known: {", ".join(AGENTS)}')
    agent_type = AGENTS[name]
    checked = agent_type.settings_type(hidden=tuple(hidden), **settings)
    return agent_type(obs_dim, act_dim, checked, torch.Generator().manual_seed(seed))
