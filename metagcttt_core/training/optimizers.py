"""The optimisers by name."""

from collections.abc import Callable, Iterable
import copy
import ctypes
from functools import partial
import math

import torch
from torch import nn

from metagcttt_core.agents.agent import Agent, OptimizerState
from metagcttt_core.kernels import Kernels
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


class KernelAdam:
    """The steps of a `torch.optim.Adam`, whose state it advances, as one call for all weights."""

    def __init__(self, optimizer: torch.optim.Adam, kernels: Kernels) -> None:
        """Go on from the state that `optimizer` has; gradients stay where they are now."""
        (self._group,) = optimizer.param_groups
        parameters = self._group['params']
        for parameter in parameters:
            if not optimizer.state[parameter]:
                optimizer.state[parameter] = {
                    'step': torch.tensor(0.0),
                    'exp_avg': torch.zeros_like(parameter),
                    'exp_avg_sq': torch.zeros_like(parameter),
                }
        states = [optimizer.state[parameter] for parameter in parameters]
        # Raised together.
        self._steps = torch.stack([state['step'] for state in states])
        self._taken = int(self._steps[0])
        for number, state in enumerate(states):
            state['step'] = self._steps[number]
        arrays = [
            parameters,
            [parameter.grad for parameter in parameters],
            [state['exp_avg'] for state in states],
            [state['exp_avg_sq'] for state in states],
        ]
        self._kept = arrays
        number = len(parameters)
        sizes = (ctypes.c_int64 * number)(*(parameter.numel() for parameter in parameters))
        addresses = [
            (ctypes.c_void_p * number)(*(array.data_ptr() for array in kind)) for kind in arrays
        ]
        self._arguments = (number, sizes, *addresses)
        self._kernels = kernels

    def step(self) -> None:
        """Take a step by the gradients."""
        self._taken += 1
        self._steps += 1
        beta1, beta2 = self._group['betas']
        self._kernels.adam(
            *self._arguments,
            beta1,
            beta2,
            self._group['lr'] / (1 - beta1**self._taken),
            math.sqrt(1 - beta2**self._taken),
            self._group['eps'],
        )


def misfit(state: OptimizerState, parameters: Iterable[nn.Parameter]) -> str:
    """Why the moments of Adam are not those of these parameters; empty if they are."""
    for number, parameter in enumerate(parameters):
        moments = state.get(number, {})
        shapes = {name: tuple(moment.shape) for name, moment in moments.items()}
        shape = tuple(parameter.shape)
        if shapes != {'step': (), 'exp_avg': shape, 'exp_avg_sq': shape}:
            return (
                f'optimiser state of parameter {number}, which has shape {shape}, does not fit '
                f'it: {shapes}'
            )
    return ''


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
    parameters = list(agent.trained_parameters())
    numbers = {parameter: number for number, parameter in enumerate(parameters)}
    if fault := misfit(state, parameters):
        raise ValueError(f'{agent.origin}: {fault}; {remedy}')
    trained = agent.trained_parameters(actor_only=actor_only)
    return {place: state[numbers[parameter]] for place, parameter in enumerate(trained)}
