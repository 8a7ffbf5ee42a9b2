"""Learned direction followers: a small network in NumPy, kept as safetensors and JSON."""

from dataclasses import dataclass, field
import hashlib
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, Self

from metagcttt_core.files import read_with_weights, write_with_weights
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError
import safetensors.numpy

from sim_bridge.controllers.follower import ControllerError
from sim_bridge.simulator import Array

_INDEX = 'controller.json'


class _Index(BaseModel):
    model_config = ConfigDict(frozen=True, extra='forbid')

    format: Literal['metagcttt-direction-follower'] = 'metagcttt-direction-follower'
    version: Literal[1] = 1
    robot: str
    layers: int = Field(ge=1)
    layer_norm: bool = False
    sha256: str = Field(pattern=r'^[0-9a-f]{64}$')
    metadata: dict[str, Any]

    @property
    def weights(self) -> str:
        """Name of the file beside this one that holds the weights."""
        return f'weights-{self.sha256[:16]}.safetensors'


@dataclass(frozen=True)
class LearnedFollower:
    """Walks along a direction by a multilayer perceptron with ReLU and a tanh at the end.

    Its input is the robot's own state, which is the observation without x and y, followed by the
    direction.

    Attributes:
        robot: The robot it can drive, such as `ant`.
        weights: Of each layer, shape (fan in, fan out), float32.
        biases: Of each layer, shape (fan out,), float32.
        metadata: How it was trained.
        layer_norm: Each hidden layer is normalised before its ReLU, without scale and offset.
    """

    robot: str
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    metadata: dict[str, Any] = field(default_factory=dict)
    layer_norm: bool = False

    def __post_init__(self) -> None:
        """Refuse layers that do not fit together.

        Raises:
            ControllerError: If a weight or bias has another shape or type, or is not finite.
        """
        for before, after in pairwise(self.weights):
            if before.ndim != 2 or after.ndim != 2 or before.shape[1] != after.shape[0]:
                raise ControllerError(f'layers {before.shape} and {after.shape} do not fit')
        for weight, bias in zip(self.weights, self.biases, strict=True):
            if bias.shape != weight.shape[1:]:
                raise ControllerError(f'layer {weight.shape} has a bias of shape {bias.shape}')
            for array in (weight, bias):
                if array.dtype != np.float32 or not np.isfinite(array).all():
                    raise ControllerError(
                        f'weights must be finite float32, got {array.dtype} of shape {array.shape}'
                    )

    @property
    def input_dim(self) -> int:
        """Numbers that the network takes."""
        return len(self.weights[0])

    @property
    def obs_dim(self) -> int:
        """Numbers in an observation of the robot, x and y included."""
        return self.input_dim  # without x and y, but with the direction

    @property
    def act_dim(self) -> int:
        """Numbers in an action."""
        return self.weights[-1].shape[1]

    @property
    def sha256(self) -> str:
        """Hash of the weights: tells which controller made a dataset."""
        return hashlib.sha256(self._serialized()).hexdigest()

    def act(self, observation: Array, direction: Array, qpos: Array) -> Array:
        """Action for an observation of shape (obs_dim,) that moves along `direction`."""
        return self.network(np.concatenate([observation[2:], direction]))

    def network(self, inputs: Array) -> Array:
        """Actions, shape (..., act_dim), for inputs of shape (..., input_dim)."""
        x = inputs.astype(np.float32)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = x @ weight + bias
            x = np.maximum(_normalized(x) if self.layer_norm else x, 0)
        return np.tanh(x @ self.weights[-1] + self.biases[-1]).astype(np.float64)

    def save(self, folder: Path) -> None:
        """Write the controller to a folder, made if missing, atomically.

        The weights go to a file named by their hash, then `controller.json`, which names that
        hash, is replaced. A crash in between leaves the previous controller whole.
        """
        index = _Index(
            robot=self.robot,
            layers=len(self.weights),
            layer_norm=self.layer_norm,
            sha256=self.sha256,
            metadata=self.metadata,
        )
        write_with_weights(folder / _INDEX, index.model_dump(), self._serialized())

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            ControllerError: If there is none, or it is damaged; the message names the file.
        """
        try:
            index, content = read_with_weights(
                lambda: _Index.model_validate_json((folder / _INDEX).read_bytes()),
                lambda index: folder / index.weights,
            )
            tensors = safetensors.numpy.load(content)
            layers = range(index.layers)
            follower = cls(
                index.robot,
                weights=tuple(tensors[f'weight{i}'] for i in layers),
                biases=tuple(tensors[f'bias{i}'] for i in layers),
                metadata=index.metadata,
                layer_norm=index.layer_norm,
            )
        except OSError as error:
            raise ControllerError(f'{folder}: no direction controller there ({error})') from error
        except (ValidationError, SafetensorError, KeyError, ControllerError) as error:
            raise ControllerError(f'{folder}: holds no usable controller: {error}') from error
        if follower.sha256 != index.sha256:
            raise ControllerError(f'{folder / index.weights}: does not match the hash in its name')
        return follower

    def _serialized(self) -> bytes:
        tensors = {f'weight{i}': weight for i, weight in enumerate(self.weights)}
        tensors |= {f'bias{i}': bias for i, bias in enumerate(self.biases)}
        return safetensors.numpy.save(tensors)


def _normalized(x: np.ndarray) -> np.ndarray:
    """Zero mean and unit variance along the last axis, as PyTorch's `layer_norm`."""
    centered = x - x.mean(axis=-1, keepdims=True)
    return centered / np.sqrt(np.square(centered).mean(axis=-1, keepdims=True) + 1e-5)
