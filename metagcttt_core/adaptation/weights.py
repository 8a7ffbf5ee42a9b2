"""An expert's weights as bytes, between processes that have the same base agent."""

from safetensors import SafetensorError
import safetensors.torch
import torch

from metagcttt_core.agents.agent import Agent

_HEADER_BYTES = 1 << 20


def changed_weights(base: Agent, expert: Agent) -> bytes:
    """The weights of `expert` that differ from those of `base`, as a safetensors file.

    Args:
        base: The agent that `expert` was adapted from.
        expert: An agent of the same networks.

    Returns:
        The content of the file; empty where no weight differs.
    """
    own = base.state_dict()
    changed = {
        name: weight.contiguous()
        for name, weight in expert.state_dict().items()
        if not torch.equal(weight, own[name])
    }
    return safetensors.torch.save(changed) if changed else b''


def with_weights(base: Agent, content: bytes) -> Agent:
    """A copy of `base` with the weights that `changed_weights` gave; its inverse.

    Raises:
        ValueError: If the content is longer than all weights, is no safetensors file, or names
            other weights than those of `base`, or of other shapes or types, or not finite.
    """
    own = base.state_dict()
    largest = _HEADER_BYTES + sum(weight.nbytes for weight in own.values())
    if len(content) > largest:
        raise ValueError(f'weights of {len(content)} bytes, the policy has at most {largest}')
    try:
        weights = safetensors.torch.load(content)
    except (SafetensorError, KeyError) as error:
        raise ValueError(f'the weights are no safetensors file ({error})') from error
    for name, weight in weights.items():
        if name not in own:
            raise ValueError(f'the policy has no weight {name!r}')
        if weight.shape != own[name].shape or weight.dtype != own[name].dtype:
            raise ValueError(
                f'weight {name} is {weight.dtype} {tuple(weight.shape)}, '
                f'not {own[name].dtype} {tuple(own[name].shape)}'
            )
        if not torch.isfinite(weight).all():
            raise ValueError(f'weight {name} holds a non-finite value')
    expert = base.clone()
    with torch.no_grad():
        for name, weight in expert.state_dict().items():
            if name in weights:
                weight.copy_(weights[name])
    return expert
