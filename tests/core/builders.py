"""Small datasets and agents that the tests of the core share."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from metagcttt_core import Agent, make_agent, TrajectoryDataset
from metagcttt_core.agents import AGENTS
import numpy as np
import pytest
import torch

EVERY_AGENT = pytest.mark.parametrize('name', sorted(AGENTS))
DATA = Path(__file__).parents[1] / 'data'


def terminals_of(lengths: Sequence[int]) -> np.ndarray:
    """(N,) bool, true on the last row of each trajectory."""
    terminals = np.zeros(sum(lengths), bool)
    terminals[np.cumsum(lengths) - 1] = True
    return terminals


def random_dataset(
    lengths: Sequence[int] = (6, 4, 5), obs_dim: int = 2, act_dim: int = 2, seed: int = 0
) -> TrajectoryDataset:
    """Random walks with actions in [-1, 1]."""
    rng = np.random.default_rng(seed)
    rows = sum(lengths)
    return TrajectoryDataset.from_arrays(
        np.cumsum(rng.normal(size=(rows, obs_dim)), axis=0),
        rng.uniform(-1, 1, size=(rows, act_dim)),
        terminals_of(lengths),
    )


def maze_walks() -> TrajectoryDataset:
    """Trajectories that wander through the medium maze's square: every task finds some."""
    rng = np.random.default_rng(0)
    steps = rng.normal(0, 0.6, size=(40, 101, 2)).cumsum(axis=1)
    observations = (steps + rng.uniform(0, 20, size=(40, 1, 2))).reshape(-1, 2)
    actions = np.clip(rng.normal(size=observations.shape), -1, 1)
    return TrajectoryDataset.from_arrays(observations, actions, terminals_of([101] * 40))


def dataset_at(trajectories: Sequence[Sequence[Any]], act_dim: int = 2) -> TrajectoryDataset:
    """A dataset whose trajectories visit the given states; actions are zero."""
    states = [np.atleast_2d(np.asarray(states, np.float32)) for states in trajectories]
    rows = sum(len(part) for part in states)
    return TrajectoryDataset.from_arrays(
        np.concatenate(states),
        np.zeros((rows, act_dim), np.float32),
        terminals_of([len(part) for part in states]),
    )


USUAL = {
    'crl': {'latent_dim': 5},
    # Advantages of random values would weigh up to 100, with which large steps end in nan.
    'saw': dict.fromkeys(('alpha', 'subpolicy_alpha', 'waypoint_alpha'), 0.1),
}


def tiny_agent(name: str = 'gcbc', seed: int = 0, **settings: Any) -> Agent:
    """An agent of a few dozen weights, in which no weight has its special initial value."""
    usual = {'obs_dim': 2, 'act_dim': 2, 'hidden': (6,), **USUAL.get(name, {})}
    agent = make_agent(name, seed=seed, **(usual | settings))
    generator = torch.Generator().manual_seed(seed + 1)
    with torch.no_grad():
        for weight in agent.parameters():
            weight.add_(0.3 * torch.randn(weight.shape, generator=generator))
    return agent


def weights_of(agent: Agent) -> dict[str, torch.Tensor]:
    """A copy of all weights by name."""
    return {name: tensor.clone() for name, tensor in agent.state_dict().items()}


def assert_bit_equal(agent: Agent, weights: dict[str, torch.Tensor]) -> None:
    """Every weight of the agent has exactly the bits given."""
    own = agent.state_dict()
    assert own.keys() == weights.keys()
    for name, tensor in own.items():
        assert torch.equal(tensor, weights[name]), f'{name} differs'


def assert_changed(agent: Agent, weights: dict[str, torch.Tensor]) -> None:
    """At least one weight differs from those given."""
    assert any(
        not torch.equal(tensor, weights[name]) for name, tensor in agent.state_dict().items()
    )
