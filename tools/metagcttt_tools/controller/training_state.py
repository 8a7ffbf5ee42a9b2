"""The state of a controller's training in one file, which knows its content by a checksum."""

from collections.abc import Mapping
import hashlib
import json
from pathlib import Path
from reprlib import repr as in_short
from typing import Any

from metagcttt_core.files import atomic_write
from safetensors import safe_open, SafetensorError
import safetensors.torch
import torch
from torch import Tensor


def write_training_state(
    path: Path, settings: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> None:
    """Write it, whole or not at all.

    Args:
        path: The file.
        settings: What decides the result, as JSON has it.
        tensors: The state by name.
    """
    metadata = {'settings': json.dumps(settings), 'checksum': _checksum(tensors)}
    with atomic_write(path) as file:
        file.write(safetensors.torch.save(dict(tensors), metadata))


def read_training_state(path: Path, settings: Mapping[str, Any]) -> dict[str, Tensor]:
    """The tensors of a training with these settings.

    Raises:
        ValueError: If the file is damaged, is something else, or is of a training with other
            settings; names the file and the first setting that differs.
    """
    try:
        with safe_open(path, framework='pt') as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError) as error:
        raise ValueError(f'{path}: cannot be read, it is damaged or no checkpoint: {error}') from (
            error
        )
    if metadata.get('checksum') != _checksum(tensors):
        raise ValueError(f'{path}: is damaged, or of another version: its checksum does not fit')
    try:
        stored = json.loads(metadata['settings'])
    except (KeyError, json.JSONDecodeError) as error:
        raise ValueError(f'{path}: is damaged, it holds no settings ({error})') from error
    for name, asked in settings.items():
        if stored.get(name) != asked:
            was, now = in_short(stored.get(name)), in_short(asked)
            raise ValueError(f'{path}: cannot resume, {name} was {was} and is now {now}')
    return tensors


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for name, tensor in sorted(tensors.items()):
        digest.update(f'{name} {tensor.dtype} {tuple(tensor.shape)}'.encode())
        digest.update(tensor.detach().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
