"""Numerics of the loss: precision and compilation. Weights and optimiser stay float32."""

from collections.abc import Callable
from functools import cache
import logging
from typing import Any, Literal

import torch
from torch import Tensor

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.training.config import Precision

LossFunction = Callable[[TensorBatch], tuple[Tensor, dict[str, Tensor]]]

_BFLOAT16_UNITS = ('amx_bf16', 'avx512_bf16')  # of x86-64
_log = logging.getLogger(__name__)

_BFLOAT16_MIN_UNITS = 256  # `metagcttt benchmark training`: at 128 units it costs


# torch's own tanh dominates GELU on a processor; written with exp it costs a quarter.
def _compile_options(device: torch.device) -> dict[str, Any] | None:
    if device.type != 'cpu':
        return None
    return {
        'cpp.use_decompose_tanh': True,
        'cpp.enable_floating_point_contract_flag': 'fast',
        'cpp.threads': torch.get_num_threads(),
    }


def resolve_precision(precision: Precision, agent: Agent) -> Literal['float32', 'bfloat16']:
    """`float32` or `bfloat16`; `auto` is bfloat16 where the agent's device gains by it.

    It does where it has matrix units for bfloat16; a processor also needs layers wide enough for
    products to outweigh the conversions. A processor that has no instructions for bfloat16 at all
    is named in a warning where it is asked for.
    """
    if precision != 'auto':
        if precision == 'bfloat16' and agent.device.type == 'cpu':
            _warn_of_slow_bfloat16()
        return precision
    if agent.device.type == 'cuda':
        gains = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        wide = min(agent.settings.hidden) >= _BFLOAT16_MIN_UNITS
        gains = wide and torch.cpu.get_capabilities().get('amx_bf16', False)
    return 'bfloat16' if gains else 'float32'


@cache
def _warn_of_slow_bfloat16() -> None:
    capabilities = torch.cpu.get_capabilities()
    is_known = capabilities.get('architecture') == 'x86_64'
    if is_known and not any(capabilities.get(name) for name in _BFLOAT16_UNITS):
        _log.warning(
            'precision bfloat16: this processor has no instructions for it, and takes several '
            'times as long as in float32; auto chooses what is faster'
        )


def loss_function(
    agent: Agent, *, precision: Precision = 'float32', compiled: bool = False
) -> LossFunction:
    """The agent's loss of a batch, computed in the given way.

    Args:
        agent: Whose `losses`, with the weights it has at each call.
        precision: Of the matrix products: `bfloat16` runs them under autocast, which keeps sums
            and losses in float32.
        compiled: Fuse the steps between matrix products with `torch.compile`, which takes up to
            half a minute before the first loss and a C++ compiler on a processor.
    """
    losses = agent.losses
    if compiled:
        losses = torch.compile(losses, options=_compile_options(agent.device))
    if resolve_precision(precision, agent) == 'float32':
        return losses

    def in_bfloat16(batch: TensorBatch) -> tuple[Tensor, dict[str, Tensor]]:
        with torch.autocast(agent.device.type, torch.bfloat16):
            return losses(batch)

    return in_bfloat16
