"""The optimisers by name."""

from collections.abc import Callable, Iterable
import copy
from functools import partial

import torch
from torch import nn, Tensor

from metagcttt_core.agents.agent import Agent
from metagcttt_core.training.config import OptimizerName

# Fused: one kernel over all parameters. Torch's Adam adds eps after bias correction, as optax
# does.
_OPTIMIZERS: dict[str, Callable[..., torch.optim.Optimizer]] = {
    'adam': partial(torch.optim.Adam, fused=True),
    'sgd': torch.optim.SGD,
}


def make_optimizer(
    name: OptimizerName,
    parameters: Iterable[nn.Parameter],
    lr: float,
    state: dict[int, dict[str, Tensor]] | None = None,
) -> torch.optim.Optimizer:
    """The named optimiser over `parameters`.

    Args:
        name: `adam` or `sgd`.
        parameters: What to train.
        lr: Learning rate.
        state: Moments and step count to begin with, by number of the parameter, on any device;
            fresh by default. Not changed.
    """
    parameters = list(parameters)
    optimizer = _OPTIMIZERS[name](parameters, lr=lr)
    if state is not None:
        # Torch keeps the very tensors it is given and steps them in place.
        optimizer.load_state_dict({**optimizer.state_dict(), 'state': copy.deepcopy(state)})
    return optimizer


def pretrained_state(agent: Agent, *, actor_only: bool = False) -> dict[int, dict[str, Tensor]]:
    """The state of Adam at the end of pre-training, as `make_optimizer` takes it.

    Args:
        agent: Whose state.
        actor_only: That of the actor's parameters alone.

    Raises:
        ValueError: If the agent has none; says where the agent comes from and what to do.
    """
    if agent.optimizer_state is None:
        raise ValueError(
            f'{agent.origin}: has no optimiser state of pre-training, which '
            'optimizer_state=pretrained needs. A checkpoint of pre-training has one, and so has a '
            'policy post-trained from it; otherwise use optimizer_state=fresh'
        )
    names = agent.named_trained_parameters(actor_only=actor_only)
    return {number: agent.optimizer_state[name] for number, name in enumerate(names)}
