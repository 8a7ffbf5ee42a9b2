"""The optimisers by name."""

from collections.abc import Callable, Iterable
import copy
from functools import partial

import torch
from torch import nn

from metagcttt_core.agents.agent import Agent, OptimizerState
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
    state: OptimizerState | None = None,
) -> torch.optim.Optimizer:
    """The named optimiser over `parameters`.

    Args:
        name: `adam` or `sgd`.
        parameters: What to train.
        lr: Learning rate.
        state: Moments and step count to begin with, by number of the parameter; fresh by default.
            Not changed.
    """
    parameters = list(parameters)
    optimizer = _OPTIMIZERS[name](parameters, lr=lr)
    if state is not None:
        # Torch keeps the very tensors it is given and steps them in place.
        optimizer.load_state_dict({**optimizer.state_dict(), 'state': copy.deepcopy(state)})
    return optimizer


def pretrained_state(agent: Agent, *, actor_only: bool = False) -> OptimizerState:
    """Adam's state at the end of pre-training, by number in the parameters to train now.

    Args:
        agent: Whose `optimizer_state`.
        actor_only: Number the actor's parameters alone.

    Raises:
        ValueError: If the agent has none, or one that does not fit its parameters; names its
            checkpoint and what to do.
    """
    state = agent.optimizer_state
    remedy = (
        'pre-train the policy anew, pack it with its optimiser state, '
        'or adapt with optimizer_state=fresh'
    )
    if state is None:
        raise ValueError(f'{agent.origin}: has no optimiser state of pre-training; {remedy}')
    numbers = {}
    for number, parameter in enumerate(agent.trained_parameters()):
        numbers[parameter] = number
        moments = state.get(number, {})
        shapes = {name: tuple(moment.shape) for name, moment in moments.items()}
        shape = tuple(parameter.shape)
        if shapes != {'step': (), 'exp_avg': shape, 'exp_avg_sq': shape}:
            raise ValueError(
                f'{agent.origin}: optimiser state of parameter {number}, which has shape {shape}, '
                f'does not fit it: {shapes}; {remedy}'
            )
    trained = agent.trained_parameters(actor_only=actor_only)
    return {place: state[numbers[parameter]] for place, parameter in enumerate(trained)}
