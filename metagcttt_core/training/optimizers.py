"""The optimisers by name."""

from collections.abc import Callable, Iterable
import copy
from functools import partial
from typing import Any

import torch
from torch import nn

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
    state: dict[int, dict[str, Any]] | None = None,
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
