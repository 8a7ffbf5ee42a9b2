"""The losses of SAW with gradients written out."""

import math

import numpy as np
import torch
from torch import Tensor

from metagcttt_core.agents.agent import TensorBatch
from metagcttt_core.agents.analytic import (
    AnalyticLoss,
    Arrays,
    evaluated,
    HALF_LOG_TWO_PI,
    join,
    outputs_of,
    take_back,
)
from metagcttt_core.agents.extraction import LARGEST_WEIGHT
from metagcttt_core.agents.networks import RepresentedGoalPolicy
from metagcttt_core.agents.passes import Passes, passes_of
from metagcttt_core.agents.saw import SAW
from metagcttt_core.kernels import Kernels

_SHORTEST = 1e-12  # as in `torch.nn.functional.normalize`


class AnalyticSAW(AnalyticLoss):
    """`SAW.losses` of an agent whose policies have unit standard deviations.

    Weights of advantages are constants: all values that they take are evaluated in one pass.
    """

    def __init__(
        self,
        agent: SAW,
        dtype: torch.dtype,
        kernels: Kernels | None = None,
        *,
        actor_only: bool,
    ) -> None:
        """The loss of `agent`, with matrix products in `dtype`."""
        self._settings = agent.settings
        self._actor_only = actor_only
        actor = agent.actor
        assert isinstance(actor, RepresentedGoalPolicy)
        networks = (
            *(actor, actor.goal_rep, agent.subpolicy, agent.value_rep),
            *(agent.value1, agent.value2, agent.target1, agent.target2),
        )
        passes = [passes_of(network, dtype, kernels) for network in networks]
        self._actor, self._subpolicy = passes[0], passes[2]
        self._actor_rep, self._value_rep = Representation(passes[1]), Representation(passes[3])
        self._values, self._targets = passes[4:6], passes[6:]
        trained = passes[: 2 if actor_only else 6]
        self.gradients = [gradient for network in trained for gradient in network.gradients]

    @torch.no_grad()
    def __call__(
        self, batch: TensorBatch, *, backward: bool = True
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """See `AnalyticLoss`."""
        arrays = {key: values.numpy() for key, values in batch.items()}
        here, there, waypoints = (
            arrays[key] for key in ('observations', 'next_observations', 'waypoints')
        )
        goals = arrays['actor_goals']
        asked = [(here, goals), (there, goals), (waypoints, goals)]
        if not self._actor_only:
            subgoals = arrays['subgoals']
            asked += [(here, subgoals), (there, subgoals), (there, arrays['value_goals'])]
        inputs = self._value_inputs(asked)
        values = _mean_of(self._values, inputs[: 5 * len(here)])
        value = values.reshape(-1, len(here))
        loss, parts = self._actor_loss(arrays, value[1] - value[0], value[2] - value[0], backward)
        if not self._actor_only:
            parts['subpolicy'] = self._subpolicy_loss(arrays, value[4] - value[3], backward)
            parts['value'] = self._value_loss(arrays, inputs[5 * len(here) :], backward)
            loss = loss + parts['value'] + parts['subpolicy']
        return torch.as_tensor(loss), {name: torch.as_tensor(part) for name, part in parts.items()}

    def _value_inputs(self, asked: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """What the values take of all states and goals, one pair after another."""
        states, goals = (np.concatenate(each) for each in zip(*asked, strict=True))
        return join(states, self._value_rep.evaluated(join(states, goals)))

    def _value_loss(self, batch: Arrays, next_inputs: np.ndarray, backward: bool) -> np.float32:
        states, size = batch['observations'], len(next_inputs)
        inputs = join(states, self._value_rep.forward(join(states, batch['value_goals'])))
        both = np.concatenate([inputs, next_inputs])
        targets = np.concatenate([evaluated(target, both) for target in self._targets], axis=1)
        discount = np.float32(self._settings.discount) * batch['masks']
        returns = batch['rewards'][:, None] + discount[:, None] * targets[size:]
        better = returns.min(1) >= targets[:size].mean(1)
        expectile = self._settings.expectile
        weight = np.where(better, np.float32(expectile), np.float32(1 - expectile))
        loss = np.float32(0)
        slope = np.zeros((size, self._value_rep.width), np.float32)
        for number, network in enumerate(self._values):
            error = returns[:, number, None] - outputs_of(network, inputs)
            weighted = weight[:, None] * error
            loss += (weighted * error).mean()
            if backward:
                gradient = take_back(network, weighted * np.float32(-2 / size), inputs=True)
                slope += gradient[:, states.shape[1] :]
        if backward:
            self._value_rep.take_back(slope)
        return loss

    def _subpolicy_loss(self, batch: Arrays, advantage: np.ndarray, backward: bool) -> np.float32:
        states = join(batch['observations'], batch['subgoals'])
        error = outputs_of(self._subpolicy, states) - batch['actions']
        weight = _weight(self._settings.subpolicy_alpha, advantage)
        if backward:
            take_back(self._subpolicy, weight[:, None] * error / np.float32(len(error)))
        return (weight * _negative_log_prob(error)).mean()

    def _actor_loss(
        self, batch: Arrays, advantage: np.ndarray, way: np.ndarray, backward: bool
    ) -> tuple[np.float32, dict[str, np.float32]]:
        """`way` is the advantage of the waypoints."""
        states = batch['observations']
        represented = self._actor_rep.forward(join(states, batch['actor_goals']))
        mean = outputs_of(self._actor, join(states, represented))
        error = mean - batch['actions']
        away = mean - evaluated(self._subpolicy, join(states, batch['waypoints']))
        weight = _weight(self._settings.alpha, advantage)
        pull = _weight(self._settings.waypoint_alpha, way)
        nll = _negative_log_prob(error)
        awr, waypoint = (weight * nll).mean(), (pull * np.square(away).sum(1)).mean()
        if backward:
            gradient = weight[:, None] * error + 2 * pull[:, None] * away
            gradient /= np.float32(len(error))
            slope = take_back(self._actor, gradient, inputs=True)
            self._actor_rep.take_back(slope[:, states.shape[1] :])
        loss = awr + waypoint
        parts = {'bc': nll.mean(), 'advantage': advantage.mean()}
        return loss, parts | {'awr': awr, 'waypoint': waypoint, 'actor': loss}


class Representation:
    """The passes of a `GoalRepresentation`: outputs of length sqrt(width)."""

    def __init__(self, passes: Passes) -> None:
        """By the `passes` of its network."""
        self._passes = passes
        self.width = passes.out_dim

    def evaluated(self, inputs: np.ndarray) -> np.ndarray:
        """The representations (B, width) of [s; g] (B, 2 obs_dim)."""
        outputs = evaluated(self._passes, inputs)
        return outputs * (math.sqrt(self.width) / _length(outputs))

    def forward(self, inputs: np.ndarray) -> np.ndarray:
        """The same, to go back from."""
        outputs = outputs_of(self._passes, inputs)
        length = _length(outputs)
        self._scale = np.float32(math.sqrt(self.width)) / length
        # Along its direction an output has no slope, unless it is too short to have one.
        self._direction = outputs / length * (length > _SHORTEST)
        return outputs * self._scale

    def take_back(self, gradient: np.ndarray) -> None:
        """Set the network's gradients by that of the representations (B, width)."""
        along = (gradient * self._direction).sum(1, keepdims=True)
        take_back(self._passes, self._scale * (gradient - along * self._direction))


def _length(outputs: np.ndarray) -> np.ndarray:
    return np.maximum(np.sqrt(np.square(outputs).sum(1, keepdims=True)), np.float32(_SHORTEST))


def _mean_of(networks: list[Passes], inputs: np.ndarray) -> np.ndarray:
    """The mean of the networks' outputs, (B,)."""
    return np.concatenate([evaluated(network, inputs) for network in networks], axis=1).mean(1)


def _weight(alpha: float, advantage: np.ndarray) -> np.ndarray:
    with np.errstate(over='ignore'):
        return np.minimum(np.exp(np.float32(alpha) * advantage), np.float32(LARGEST_WEIGHT))


def _negative_log_prob(error: np.ndarray) -> np.ndarray:
    """Of actions (B, act_dim) off the mean by `error`, (B,)."""
    constant = np.float32(error.shape[1] * HALF_LOG_TWO_PI)
    return np.square(error).sum(1) * np.float32(0.5) + constant
