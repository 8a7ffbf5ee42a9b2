"""The value function of an agent as the retrieval takes it, with the weights it has now."""

from dataclasses import dataclass
import hashlib
from typing import Protocol, Self

import numpy as np
import torch
from torch import nn, Tensor

from metagcttt_core.data.scaling import Scaling

# Rows a processor evaluates at a time, so that what lies between the layers stays in its cache.
_BLOCK_ROWS = 512


class ValueAgent(Protocol):
    """An agent that has a value function."""

    scaling: Scaling

    @property
    def device(self) -> torch.device:
        """Device of the weights."""

    def state_value(self, observations: Tensor, goals: Tensor) -> Tensor:
        """V(s, g) of observations and goals (B, obs_dim), (B,)."""


@dataclass(frozen=True)
class StateValue:
    """V of an agent with the weights it has now; equal only while the weights stay the same.

    Attributes:
        agent: Whose value to evaluate.
        digest: Of the weights that it depends on.
    """

    agent: ValueAgent
    digest: bytes

    @classmethod
    def of(cls, agent: ValueAgent, *networks: nn.Module) -> Self:
        """The value of `agent`, which depends on the weights of `networks`."""
        digest = hashlib.blake2b(digest_size=16)
        for network in networks:
            for weight in network.parameters():
                digest.update(weight.detach().cpu().numpy().data)
        return cls(agent, digest.digest())

    @torch.inference_mode()
    def __call__(self, observations: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """V(observations (n, obs_dim) | goal (obs_dim,)), (n,) float32."""
        device = self.agent.device
        scaled = self.agent.scaling.observations
        states = torch.from_numpy(scaled(observations)).to(device)
        goals = torch.from_numpy(scaled(goal)).to(device).expand_as(states)
        if device.type != 'cpu':
            return self.agent.state_value(states, goals).cpu().numpy()
        blocks = zip(states.split(_BLOCK_ROWS), goals.split(_BLOCK_ROWS), strict=True)
        return torch.cat([self.agent.state_value(*block) for block in blocks]).numpy()
