"""Interface of every goal-conditioned agent."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
import hashlib
import math
from typing import Any, ClassVar, Self, TYPE_CHECKING

import numpy as np
import torch
from torch import nn, Tensor

from metagcttt_core.agents.config import AgentSettings
from metagcttt_core.agents.copying import copied
from metagcttt_core.agents.networks import MLP
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.errors import DatasetError
from metagcttt_core.data.identity import identity_fault
from metagcttt_core.data.relabel import GoalRelabeller
from metagcttt_core.data.scaling import Scaling

if TYPE_CHECKING:
    from metagcttt_core.agents.analytic import AnalyticLoss
    from metagcttt_core.kernels import Kernels

TensorBatch = dict[str, Tensor]
OptimizerState = dict[int, dict[str, Tensor]]
"""Moments and step count by name, for each trained parameter by its number."""
_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class Agent(nn.Module, ABC):
    """A policy pi(a | s, g) with the losses that train it.

    Attributes:
        obs_dim, act_dim: Widths of an observation (and goal) and of an action.
        settings: The agent's settings, defaults resolved.
        scaling: Between physical units, which everything public here takes and gives, and those
            of the networks; the identity at first. It travels with the weights.
        metadata: Facts that travel with the weights (`environment`, `history`, ...).
        optimizer_state: Adam's at the end of pre-training, by number in `trained_parameters()`,
            None where it is not known. It travels with the weights, whatever is done to them, and
            is never changed; `TTTConfig(optimizer_state='pretrained')` begins with it.
        origin: Name for error messages: the checkpoint that it was loaded from.
    """

    name: ClassVar[str]
    settings_type: ClassVar[type[AgentSettings]]
    plain_policy: ClassVar[str] = 'actor'
    """The network from [s; g] to means of actions, which tells the agent's widths."""
    reference_networks: ClassVar[Mapping[str, tuple[str, ...]]] = {'modules_actor': ('actor',)}
    """The networks under OGBench's names; several where OGBench stacks them along an axis."""

    def __init__(
        self, obs_dim: int, act_dim: int, settings: AgentSettings, generator: torch.Generator
    ) -> None:
        """Build the actor; subclasses add value networks."""
        super().__init__()
        for field, value in (('obs_dim', obs_dim), ('act_dim', act_dim)):
            if value < 1:
                raise ValueError(f'{field} must be at least 1, got {value}')
        self.obs_dim = obs_dim
        self.act_dim = act_dim
        self.settings = settings
        self.scaling = Scaling.identity(obs_dim, act_dim)
        self.metadata: dict[str, Any] = {}
        self.optimizer_state: OptimizerState | None = None
        self.origin = 'the agent'
        self.actor = self.make_actor(generator)

    def make_actor(self, generator: torch.Generator) -> MLP:
        """A fresh policy network: [s; g] (..., 2 obs_dim) -> means of actions (..., act_dim)."""
        return self.with_stds(
            MLP(
                2 * self.obs_dim,
                self.settings.hidden,
                self.act_dim,
                head='mean',
                head_scale=0.01,
                generator=generator,
            )
        )

    def with_stds(self, policy: MLP) -> MLP:
        """`policy` with log standard deviations of its own, if they are learned."""
        if not self.settings.const_std:
            policy.register_parameter('log_stds', nn.Parameter(torch.zeros(self.act_dim)))
        return policy

    def check(self, dataset: TrajectoryDataset) -> None:
        """Refuse data that this policy can be neither trained nor adapted on.

        Raises:
            DatasetError: If they are of other widths or of another robot's contract, or outside
                the scaling.
        """
        where = f'the dataset {dataset.source}' if dataset.source else 'the dataset'
        own, others = (self.obs_dim, self.act_dim), (dataset.obs_dim, dataset.act_dim)
        if own != others:
            raise DatasetError(
                f'{self.origin} is for observations of {own[0]} and actions of {own[1]} values, '
                f'{where} has {others[0]} and {others[1]}'
            )
        if fault := identity_fault(where, dataset.contract, self.metadata.get('contract')):
            raise DatasetError(f'{fault}, as {self.origin} is')
        self.scaling.check(dataset)

    @abstractmethod
    def losses(
        self, batch: TensorBatch, *, actor_only: bool = False
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The training loss of a batch and its named parts.

        Args:
            batch: Tensors by OGBench's keys, as `GoalRelabeller` makes them.
            actor_only: Leave out the terms that do not train the actor.
        """

    def update_targets(self) -> None:
        """Move the networks that trail others; called with each full update, before its step."""

    def analytic_loss(
        self,
        *,
        actor_only: bool = False,
        dtype: torch.dtype = torch.float32,
        kernels: 'Kernels | None' = None,
    ) -> 'AnalyticLoss | None':
        """The same loss with its gradient written out, or None where `losses` is all there is.

        Args:
            actor_only: Leave out the terms that do not train the actor.
            dtype: Of the operands of matrix products.
            kernels: Compute by these, from `load_kernels`; in tensor operations by default.
        """
        return None

    @property
    def value_fn(self) -> Callable[[np.ndarray, np.ndarray], np.ndarray] | None:
        """V(observations (n, obs_dim), goal (obs_dim,)) -> (n,), or None without a critic."""
        return None

    def relabeller(self, dataset: TrajectoryDataset) -> GoalRelabeller:
        """The source of batches that `losses` takes."""
        return GoalRelabeller(
            dataset, self.settings.goals, self.settings.discount, scaling=self.scaling
        )

    def trained_parameters(self, *, actor_only: bool = False) -> Iterator[nn.Parameter]:
        """The parameters an optimiser steps on."""
        module = self.actor if actor_only else self
        return (parameter for parameter in module.parameters() if parameter.requires_grad)

    def fingerprint(self) -> str:
        """Hash of all that decides how it acts and adapts, 16 hexadecimal digits.

        That is the weights, the scaling, the settings, and the optimiser state of pre-training.
        """
        digest = hashlib.blake2b(digest_size=8)
        tensors = dict(self.state_dict())
        for number, state in (self.optimizer_state or {}).items():
            tensors |= {f'{number}.{name}': tensor for name, tensor in state.items()}
        for name, tensor in sorted(tensors.items()):
            digest.update(f'{name}{tuple(tensor.shape)}'.encode())
            digest.update(tensor.cpu().numpy().tobytes())
        if not self.scaling.is_identity:
            digest.update(repr(self.scaling.to_json()).encode())
        digest.update(f'{self.name} {self.settings.model_dump_json()}'.encode())
        return digest.hexdigest()

    def clone(self) -> Self:
        """An independent copy with equal weights, and the same optimiser state."""
        # Never changed, and as large as the weights or slow to copy: shared.
        return copied(self, {id(part): part for part in (self.optimizer_state, self.settings)})

    def log_prob(
        self, observations: Tensor, goals: Tensor, actions: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Log-density of actions under the policy, (B,), and the policy's means, (B, act_dim)."""
        return self.log_prob_of(self.actor, observations, goals, actions)

    def log_prob_of(
        self, policy: nn.Module, observations: Tensor, goals: Tensor, actions: Tensor
    ) -> tuple[Tensor, Tensor]:
        """As `log_prob`, of another policy network than the actor."""
        mean = policy(torch.cat([observations, goals], dim=-1))
        error = actions - mean
        if self.settings.const_std:
            return (-0.5 * error.square() - _HALF_LOG_TWO_PI).sum(-1), mean
        log_std = log_std_of(policy)
        return (-0.5 * (error / log_std.exp()).square() - log_std - _HALF_LOG_TWO_PI).sum(-1), mean

    @torch.inference_mode()
    def act(
        self,
        observation: np.ndarray,
        goal: np.ndarray,
        *,
        temperature: float = 0.0,
        rng: np.random.Generator | None = None,
    ) -> np.ndarray:
        """The action for one observation or a batch: the policy's mode, within its limits.

        Args:
            observation: (obs_dim,) or (n, obs_dim), finite.
            goal: (obs_dim,), or (n, obs_dim) for a batch.
            temperature: Scale of the standard deviation; 0 acts deterministically.
            rng: Source of the noise; needed when the temperature is above 0.

        Returns:
            (act_dim,) or (n, act_dim) float32, clipped to `scaling.limit` either way: 1 unless the
            policy was trained on larger actions.

        Raises:
            ValueError: For a wrong width or a non-finite value.
        """
        observation = _checked('observation', observation, self.obs_dim)
        goal = _checked('goal', goal, self.obs_dim)
        if goal.ndim < observation.ndim:
            goal = np.broadcast_to(goal, observation.shape)
        if goal.shape != observation.shape:
            raise ValueError(
                f'goal of shape {goal.shape} does not fit observation of shape {observation.shape}'
            )
        seen = [self.scaling.observations(each) for each in (observation, goal)]
        inputs = torch.from_numpy(np.concatenate(seen, axis=-1))
        mean = self.actor(inputs.to(self.device)).cpu().numpy()
        if temperature > 0:
            if rng is None:
                raise ValueError('acting with a temperature above 0 needs an rng')
            std = 1.0 if self.settings.const_std else log_std_of(self.actor).exp().cpu().numpy()
            mean = mean + temperature * std * rng.standard_normal(mean.shape, dtype=np.float32)
        return self.scaling.physical_actions(np.clip(mean, -1, 1))

    def _has_analytic_loss_of(self, agent_type: type['Agent']) -> bool:
        """True if the loss written out for `agent_type` is this agent's, no subclass's."""
        return type(self) is agent_type and self.settings.const_std and self.device.type == 'cpu'

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return next(self.parameters()).device

    def tensors(self, batch: Mapping[str, np.ndarray]) -> TensorBatch:
        """A batch as tensors on the agent's device."""
        return {
            key: torch.from_numpy(np.ascontiguousarray(value)).to(self.device)
            for key, value in batch.items()
        }

    @torch.no_grad()
    def import_reference_parameters(self, mapping: Mapping[str, np.ndarray]) -> None:
        """Load weights named as in OGBench's reference implementation.

        Args:
            mapping: Arrays by name `<net>.<layer>.<tensor>`: `kernel` (fan_in, fan_out) and
                `bias` of `fc0`,
                `fc1`, ..., `mean` (actor) or `out`; `scale` and `bias` of `ln0`, ...

        Raises:
            ValueError: If a name is missing or unknown, or a shape is wrong. No weight has
                changed then.
        """
        own = self.state_dict(keep_vars=True)
        expected = {_reference_name(name, tensor): tensor for name, tensor in own.items()}
        missing, unknown = (
            sorted(expected.keys() - mapping.keys()),
            sorted(mapping.keys() - expected.keys()),
        )
        if missing or unknown:
            raise ValueError(
                f'reference parameters do not fit a {self.name} agent: '
                f'missing {missing or "none"}, unknown {unknown or "none"}'
            )
        arrays = {name: np.asarray(mapping[name], dtype=np.float32) for name in expected}
        for name, tensor in expected.items():
            shape = tuple(tensor.shape)[::-1] if name.endswith('.kernel') else tuple(tensor.shape)
            if arrays[name].shape != shape:
                raise ValueError(
                    f'reference parameter {name} must have shape {shape}, got {arrays[name].shape}'
                )
            if not np.isfinite(arrays[name]).all():
                raise ValueError(f'reference parameter {name} holds a non-finite value')
        for name, tensor in expected.items():
            tensor.copy_(
                torch.from_numpy(arrays[name].T if name.endswith('.kernel') else arrays[name])
            )

    def export_reference_parameters(self) -> dict[str, np.ndarray]:
        """The weights under the names of `import_reference_parameters`; its inverse."""
        exported = {}
        for own_name, tensor in self.state_dict().items():
            name = _reference_name(own_name, tensor)
            array = tensor.cpu().numpy().copy()
            exported[name] = array.T if name.endswith('.kernel') else array
        return exported


def log_std_of(policy: nn.Module) -> Tensor:
    """Log standard deviations of a policy that learns them, (act_dim,)."""
    # Not by `get_parameter`: `functional_call` puts plain tensors in the parameters' places.
    return dict(policy.named_parameters())['log_stds'].clamp(-5, 2)


def _reference_name(name: str, tensor: Tensor) -> str:
    layer, _, kind = name.rpartition('.')
    if kind != 'weight':
        return name
    return f'{layer}.kernel' if tensor.ndim == 2 else f'{layer}.scale'


def _checked(name: str, values: np.ndarray, width: int) -> np.ndarray:
    array = np.asarray(values)
    if array.ndim not in (1, 2) or array.shape[-1] != width:
        raise ValueError(f'{name} must have shape ({width},) or (n, {width}), got {array.shape}')
    with np.errstate(over='ignore'):
        finite = np.isfinite(array.astype(np.float32)).all()
    if not finite:
        raise ValueError(f'{name} holds a non-finite value')
    return array
