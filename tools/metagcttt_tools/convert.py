"""Turn parameters of OGBench's own JAX agents into a checkpoint to deploy and train on here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import re
from typing import Annotated, Any, TYPE_CHECKING

from metagcttt_core import DatasetError
from metagcttt_core.agents import AgentName, AGENTS
from metagcttt_core.agents.config import ActorLoss
from metagcttt_core.config import Settings
from metagcttt_core.data.npz import read_arrays
import numpy as np
from pydantic import Field
import tyro

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.session import sole_writer

if TYPE_CHECKING:
    from metagcttt_core import Agent

_DESCRIPTION = """Turn parameters of OGBench's JAX agents (.npz) into a checkpoint.

Example: metagcttt convert params.npz --agent gciql --alpha 0.003
The arrays have OGBench's names, joined by dots, as `np.savez('params.npz',
**flax.traverse_util.flatten_dict(agent.network.params, sep='.'))` writes them, or ours:
actor.fc0.kernel, value.ln0.scale, critic1.out.bias, ... Widths follow from the arrays."""


class ConvertSettings(Settings):
    """Settings of the program."""

    file: Annotated[Path, tyro.conf.Positional] = Field(
        Path('params.npz'), description='named arrays (npz)'
    )
    agent: AgentName = Field('gcbc', description='kind of agent')
    environment: str = Field('pointmaze-medium-v0', description='simulator the policy is for')
    discount: float = Field(
        0.99, gt=0, lt=1, description='discount that the agent was trained with'
    )
    actor_loss: ActorLoss | None = Field(None, description='of GCIQL and CRL, to train it further')
    alpha: float | None = Field(None, ge=0, description='of its actor loss, to train it further')
    prefix: str = Field('', description='convert only the arrays under this name, such as init')
    out: Path = Field(Path('out/converted'), description='folder for the checkpoint')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(ConvertSettings, _DESCRIPTION, 'convert', argv)
    from metagcttt_core import save_checkpoint
    from metagcttt_core.training.checkpoint import has_checkpoint

    try:
        arrays = under_prefix(read_arrays(settings.file, []), settings.prefix)
        extra = settings.model_dump(include={'actor_loss', 'alpha'}, exclude_none=True)
        agent = agent_from(arrays, settings.agent, discount=settings.discount, **extra)
    except DatasetError as error:
        fail(str(error))
    except ValueError as error:
        fail(f'{settings.file}: {error}')
    agent.metadata = {
        'environment': settings.environment,
        'history': [{'stage': 'converted', 'file': settings.file.name}],
    }
    with sole_writer(settings.out):
        if has_checkpoint(settings.out):
            fail(f'{settings.out} holds a checkpoint: choose another --out')
        save_checkpoint(agent, settings.out)
    print(
        f'{agent.name}, {agent.obs_dim} observations, {agent.act_dim} actions, '
        f'{" x ".join(map(str, agent.settings.hidden))} units: {settings.out}'
    )


def under_prefix(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays named `prefix`.NAME, by NAME; all of them without a prefix."""
    start = f'{prefix}.' if prefix else ''
    return {
        name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)
    }


def agent_from(arrays: Mapping[str, np.ndarray], name: AgentName, **settings: Any) -> Agent:
    """The agent that reference arrays describe.

    Args:
        arrays: By OGBench's names (`modules_...`) or those of `Agent.import_reference_parameters`.
        name: Kind of agent.
        settings: Further settings of the agent; units and `const_std` follow from the arrays.

    Raises:
        ValueError: If arrays are missing, unknown or of a wrong shape; names them.
    """
    from metagcttt_core import make_agent

    agent_type = AGENTS.find(name)
    own = from_ogbench_names(arrays, agent_type.reference_networks)
    policy = agent_type.plain_policy
    layers = (*_hidden_layers(own, policy), 'mean')
    kernels = [own.get(f'{policy}.{layer}.kernel') for layer in layers]
    if len(kernels) < 2 or any(kernel is None or kernel.ndim != 2 for kernel in kernels):
        found = ', '.join(sorted(own)) or 'no arrays'
        raise ValueError(
            f'the {policy} needs kernels {policy}.fc0.kernel, {policy}.fc1.kernel, ..., '
            f'{policy}.mean.kernel of two dimensions; found: {found}'
        )
    widths = [kernel.shape for kernel in kernels if kernel is not None]
    agent = make_agent(
        name,
        obs_dim=widths[0][0] // 2,
        act_dim=widths[-1][1],
        hidden=[out for _, out in widths[:-1]],
        const_std='actor.log_stds' not in own,
        **settings,
    )
    agent.import_reference_parameters(own)
    return agent


def _hidden_layers(arrays: Mapping[str, np.ndarray], policy: str) -> list[str]:
    count = sum(bool(re.fullmatch(rf'{policy}\.fc\d+\.kernel', name)) for name in arrays)
    return [f'fc{index}' for index in range(count)]


def from_ogbench_names(
    arrays: Mapping[str, np.ndarray], networks: Mapping[str, tuple[str, ...]]
) -> dict[str, np.ndarray]:
    """The arrays by our names; those that do not begin with `modules_` keep theirs.

    OGBench stacks twin networks along a first axis and numbers a network's linear layers, the last
    of which is the head, unless it is named.

    Args:
        arrays: By OGBench's names.
        networks: Our networks by OGBench's names; see `Agent.reference_networks`.
    """
    renamed = {}
    heads = {net: _last_dense(arrays, net) for net in networks}
    for name, array in arrays.items():
        net, _, rest = name.partition('.')
        if net not in networks:
            renamed[name] = array
            continue
        rest = re.sub(r'^(actor_net|value_net|layers_0)\.', '', rest).replace('mean_net.', 'mean.')
        if f'{net}.mean_net.kernel' not in arrays:
            rest = rest.replace(f'Dense_{heads[net]}.', 'out.')
        rest = re.sub(r'\bDense_(\d+)\.', r'fc\1.', rest)
        rest = re.sub(r'\bLayerNorm_(\d+)\.', r'ln\1.', rest)
        targets = networks[net]
        if len(targets) == 1:
            renamed[f'{targets[0]}.{rest}'] = array
            continue
        if array.ndim == 0 or len(array) != len(targets):
            raise ValueError(
                f'{name} must hold two networks along its first axis, got {array.shape}'
            )
        renamed |= {f'{target}.{rest}': part for target, part in zip(targets, array, strict=True)}
    return renamed


def _last_dense(arrays: Mapping[str, np.ndarray], net: str) -> int | None:
    pattern = re.compile(rf'{net}\.(?:value_net|layers_0|phi)\.Dense_(\d+)\.kernel')
    return max((int(m[1]) for m in map(pattern.fullmatch, arrays) if m), default=None)
