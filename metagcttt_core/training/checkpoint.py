"""Checkpoints: safetensors for the weights, JSON for the rest, never pickle."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
import re
from typing import Any

from pydantic import BaseModel, Field, field_validator, ValidationError
from safetensors import SafetensorError
import safetensors.torch
import torch
from torch import Tensor

from metagcttt_core.agents import AGENTS
from metagcttt_core.agents.agent import Agent, OptimizerState
from metagcttt_core.config.settings import error_lines, Settings
from metagcttt_core.data.scaling import Scaling
from metagcttt_core.files import (
    read_json,
    read_with_weights,
    WEIGHTS,
    weights_name,
    write_with_weights,
)

FORMAT_VERSION = 1
_INDEX = 'checkpoint.json'
_PRETRAINING = 'pretrain'  # the stage
_OPTIMIZER_TENSOR = r'(optimizer|pretraining)\.(\d{1,9})\.(\w+)'
_NEVER_NEGATIVE = ('.step', '.exp_avg_sq')


class CheckpointError(ValueError):
    """A checkpoint that cannot be used; the message names the file and what is wrong."""


@dataclass(frozen=True)
class TrainingState:
    """State, besides the weights, from which a run goes on as if never interrupted.

    Attributes:
        stage: `pretrain` or `post_train`.
        step: Steps done.
        settings: The run's settings, to refuse going on with others.
        optimizer: The state of the run's own optimiser.
    """

    stage: str
    step: int
    settings: dict[str, Any]
    optimizer: OptimizerState = field(default_factory=dict)


class _Training(Settings):
    stage: str
    step: int = Field(ge=0)
    settings: dict[str, Any]


class _Metadata(BaseModel):
    """What programs look up in the metadata; whatever else is in there is kept."""

    environment: str | None = None
    history: list[dict[str, Any]] = []
    contract: dict[str, Any] | None = None


class _Index(Settings):
    format: str = 'metagcttt-checkpoint'
    version: int
    agent: str
    obs_dim: int = Field(ge=1, le=10**6)
    act_dim: int = Field(ge=1, le=10**6)
    settings: dict[str, Any]
    metadata: dict[str, Any]
    scaling: dict[str, Any] | None = None
    weights: str = Field(pattern=rf'^{WEIGHTS}$')
    training: _Training | None = None

    @field_validator('metadata')
    @classmethod
    def _check_metadata(cls, metadata: dict[str, Any]) -> dict[str, Any]:
        _Metadata.model_validate(metadata)
        return metadata


def save_checkpoint(agent: Agent, path: str | Path, training: TrainingState | None = None) -> None:
    """Write an agent to the folder `path`, atomically.

    The weights go to a file named by their hash, then `checkpoint.json`, which names that file, is
    replaced. A crash in between leaves the previous checkpoint whole.

    Two optimisers may have a state in there: the run's own (`optimizer.`) and, with the agent,
    that of pre-training (`pretraining.`). In a pre-training run they are one, saved once.

    Args:
        agent: What to save, with its `metadata` and `optimizer_state`.
        path: The folder; made if missing.
        training: The state of the run, to be resumed later.

    Raises:
        CheckpointError: If a number is not finite; such a checkpoint could not be loaded.
        OSError: If the folder cannot be written.
        After either, the previous checkpoint is still there.
    """
    folder = Path(path)
    tensors = {f'agent.{name}': tensor for name, tensor in agent.state_dict().items()}
    if training is not None:
        tensors |= _named('optimizer', training.optimizer)
    if training is None or training.stage != _PRETRAINING:
        tensors |= _named('pretraining', agent.optimizer_state or {})
    for name, tensor in tensors.items():
        if not torch.isfinite(tensor).all():
            what = name if (weight := name.removeprefix('agent.')) == name else f'weight {weight}'
            raise CheckpointError(f'{folder}: not saved, {what} holds a non-finite value')
    content = safetensors.torch.save({name: t.contiguous().cpu() for name, t in tensors.items()})
    index = _Index(
        version=FORMAT_VERSION,
        agent=agent.name,
        obs_dim=agent.obs_dim,
        act_dim=agent.act_dim,
        settings=agent.settings.model_dump(mode='json'),
        metadata=agent.metadata,
        scaling=None if agent.scaling.is_identity else agent.scaling.to_json(),
        weights=weights_name(content),
        training=training
        and _Training(stage=training.stage, step=training.step, settings=training.settings),
    )
    # Without a scaling, programs of before there was one can read it.
    unused = set() if index.scaling else {'scaling'}
    write_with_weights(folder / _INDEX, index.model_dump(mode='json', exclude=unused), content)


def load_checkpoint(
    path: str | Path,
    *,
    environment: str | None = None,
    changes: Mapping[str, Any] | None = None,
) -> Agent:
    """The agent saved in the folder `path`, with its metadata and optimiser state.

    Args:
        path: The folder, or its `checkpoint.json`.
        environment: Refuse a checkpoint trained for another environment.
        changes: Settings of the agent to use instead of the saved ones, such as `actor_loss`.

    Raises:
        CheckpointError: If there is none, it is damaged, of another version, or does not fit; the
            message names what.
    """
    folder = _folder(path)
    index, tensors = _read(folder)
    trained_for = index.metadata.get('environment')
    if environment is not None and trained_for != environment:
        raise CheckpointError(
            f'{folder}: trained for environment {trained_for!r}, not for {environment!r}'
        )
    if index.agent not in AGENTS:
        raise CheckpointError(
            f'{folder}: unknown agent {index.agent!r}; known: {", ".join(AGENTS)}'
        )
    agent_type = AGENTS[index.agent]
    try:
        settings = agent_type.settings_type(**index.settings | dict(changes or {}))
    except ValidationError as error:
        raise CheckpointError(f'{folder}: settings: {"; ".join(error_lines(error))}') from error
    with torch.device('meta'):  # shapes alone: an index may announce more than memory holds
        shapes = agent_type(index.obs_dim, index.act_dim, settings, torch.Generator('cpu'))
    own = shapes.state_dict()
    saved = {name[6:]: tensor for name, tensor in tensors.items() if name.startswith('agent.')}
    missing, unknown = sorted(own.keys() - saved.keys()), sorted(saved.keys() - own.keys())
    if missing or unknown:
        raise CheckpointError(
            f'{folder}: weights do not fit the settings: missing {missing}, unknown {unknown}'
        )
    for name, tensor in own.items():
        if saved[name].shape != tensor.shape:
            raise CheckpointError(
                f'{folder}: weight {name} has shape {tuple(saved[name].shape)}, '
                f'the settings ask for {tuple(tensor.shape)}'
            )
    agent = agent_type(index.obs_dim, index.act_dim, settings, torch.Generator())
    if index.scaling is not None:
        try:
            agent.scaling = Scaling.from_json(index.scaling, index.obs_dim, index.act_dim)
        except (ValueError, TypeError) as error:
            raise CheckpointError(f'{folder}: {error}') from error
    agent.load_state_dict(saved)
    agent.metadata = dict(index.metadata)
    own_run = index.training is not None and index.training.stage == _PRETRAINING
    agent.optimizer_state = _state('optimizer' if own_run else 'pretraining', tensors) or None
    agent.origin = str(folder)
    return agent


def steps_done(path: str | Path) -> int:
    """Steps of the run that wrote the checkpoint in `path`; 0 without one."""
    if not has_checkpoint(path):
        return 0
    training = _read_index(_folder(path)).training
    return training.step if training is not None else 0


def load_training_state(path: str | Path) -> TrainingState:
    """The state of the run that wrote the checkpoint in `path`.

    Raises:
        CheckpointError: If there is no checkpoint or it was saved without a training state.
    """
    folder = _folder(path)
    index, tensors = _read(folder)
    if index.training is None:
        raise CheckpointError(f'{folder}: was saved without a training state, cannot be resumed')
    training = index.training
    optimizer = _state('optimizer', tensors)
    return TrainingState(training.stage, training.step, training.settings, optimizer)


def has_checkpoint(path: str | Path) -> bool:
    """Whether the folder `path` holds a checkpoint."""
    return (Path(path) / _INDEX).is_file()


def _named(group: str, optimizer: OptimizerState) -> dict[str, Tensor]:
    return {
        f'{group}.{number}.{name}': tensor
        for number, state in optimizer.items()
        for name, tensor in state.items()
    }


def _state(group: str, tensors: Mapping[str, Tensor]) -> OptimizerState:
    """The inverse of `_named`; empty where there is none."""
    optimizer: OptimizerState = {}
    for name, tensor in tensors.items():
        match = re.fullmatch(_OPTIMIZER_TENSOR, name)
        if match and match[1] == group:
            optimizer.setdefault(int(match[2]), {})[match[3]] = tensor
    return optimizer


def _folder(path: str | Path) -> Path:
    path = Path(path)
    return path.parent if path.name == _INDEX else path


def _read_index(folder: Path) -> _Index:
    file = folder / _INDEX
    try:
        values = read_json(file)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise CheckpointError(f'{folder}: no checkpoint there ({_INDEX} is missing)') from error
    except (OSError, ValueError) as error:
        raise CheckpointError(str(error)) from error
    if values.get('format') != 'metagcttt-checkpoint':
        raise CheckpointError(f'{file}: not a checkpoint of this project (format is missing)')
    if values.get('version') != FORMAT_VERSION:
        raise CheckpointError(
            f'{file}: is of format version {values.get("version")!r}; '
            f'this program reads version {FORMAT_VERSION}'
        )
    try:
        return _Index(**values)
    except ValidationError as error:
        raise CheckpointError(f'{file}: {"; ".join(error_lines(error))}') from error


def _read(folder: Path) -> tuple[_Index, dict[str, Tensor]]:
    """The index and the tensors of one and the same save, even while the next one replaces it."""
    try:
        index, content = read_with_weights(
            lambda: _read_index(folder), lambda index: folder / index.weights
        )
    except OSError as error:
        reason = 'is missing' if isinstance(error, FileNotFoundError) else error.strerror
        raise CheckpointError(f'{error.filename}: {reason}') from error
    file = folder / index.weights
    if weights_name(content) != file.name:
        raise CheckpointError(
            f'{file}: is damaged, its content does not match the hash in its name'
        )
    try:
        tensors = safetensors.torch.load(content)
    except (SafetensorError, KeyError) as error:  # the latter for types that PyTorch lacks
        raise CheckpointError(f'{file}: is not a safetensors file ({error})') from error
    for name, tensor in tensors.items():
        _check_tensor(folder, name, tensor)
    return index, tensors


def _check_tensor(folder: Path, name: str, tensor: Tensor) -> None:
    """Refuse what is neither a weight nor the state of an optimiser, or cannot be used."""
    weight = name.removeprefix('agent.')
    what = name if weight == name else f'weight {weight}'
    if weight == name and not re.fullmatch(_OPTIMIZER_TENSOR, name):
        raise CheckpointError(f'{folder}: unknown tensor {name}')
    half = weight != name and tensor.dtype == torch.float16
    if not (half or tensor.dtype == torch.float32):
        expected = 'float32' if weight == name else 'float32 or float16'
        raise CheckpointError(f'{folder}: {what} is {tensor.dtype}, expected {expected}')
    if not torch.isfinite(tensor).all():
        raise CheckpointError(f'{folder}: {what} holds a non-finite value')
    if name.endswith(_NEVER_NEGATIVE) and (tensor < 0).any():
        raise CheckpointError(f'{folder}: {what} holds a negative value')
