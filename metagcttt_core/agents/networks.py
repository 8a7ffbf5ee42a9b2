"""The multilayer perceptron of OGBench's agents."""

import math

import torch
from torch import nn, Tensor
from torch.nn import functional


class MLP(nn.Module):
    """Linear, GELU (tanh form) and optionally layer norm per hidden layer, then a linear head.

    Kernels start uniform on [-L, L] with L = sqrt(6 c / (fan_in + fan_out)), c = 1 (`head_scale`
    for the head); biases start at 0.
    """

    def __init__(
        self,
        in_dim: int,
        hidden: tuple[int, ...],
        out_dim: int,
        *,
        head: str = 'out',
        head_scale: float = 1.0,
        layer_norm: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        """Build the layers `fc0`, `ln0`, ... and `head`."""
        super().__init__()
        self.head_name = head
        self.num_hidden = len(hidden)
        self.layer_norm = layer_norm
        widths = (in_dim, *hidden)
        for index in range(len(hidden)):
            self.add_module(
                f'fc{index}', _linear(widths[index], widths[index + 1], 1.0, generator)
            )
            if layer_norm:
                self.add_module(f'ln{index}', nn.LayerNorm(widths[index + 1], eps=1e-6))
        self.add_module(head, _linear(widths[-1], out_dim, head_scale, generator))

    def forward(self, inputs: Tensor) -> Tensor:
        """Map (..., in_dim) to (..., out_dim)."""
        x = inputs
        for index in range(self.num_hidden):
            x = functional.gelu(self.get_submodule(f'fc{index}')(x), approximate='tanh')
            if self.layer_norm:
                x = self.get_submodule(f'ln{index}')(x)
        # As wide as the inputs, also where autocast computes the layers in bfloat16.
        return self.get_submodule(self.head_name)(x).to(inputs.dtype)


class GoalRepresentation(MLP):
    """phi([s; g]) of length sqrt(width): a layer-normed MLP, its output normalised."""

    def forward(self, inputs: Tensor) -> Tensor:
        """Map [s; g] (..., 2 obs_dim) to (..., width)."""
        output = functional.normalize(super().forward(inputs), dim=-1)
        return output * math.sqrt(output.shape[-1])


class RepresentedGoalPolicy(MLP):
    """Means of actions from a state and its own representation of state and goal."""

    def __init__(
        self,
        obs_dim: int,
        hidden: tuple[int, ...],
        act_dim: int,
        rep_dim: int,
        generator: torch.Generator | None = None,
    ) -> None:
        """Build the policy's layers and `goal_rep`."""
        super().__init__(
            obs_dim + rep_dim,
            hidden,
            act_dim,
            head='mean',
            head_scale=0.01,
            generator=generator,
        )
        self.obs_dim = obs_dim
        self.goal_rep = GoalRepresentation(
            2 * obs_dim, hidden, rep_dim, layer_norm=True, generator=generator
        )

    def forward(self, inputs: Tensor) -> Tensor:
        """Map [s; g] (..., 2 obs_dim) to (..., act_dim)."""
        states = inputs[..., : self.obs_dim]
        return super().forward(torch.cat([states, self.goal_rep(inputs)], dim=-1))


def _linear(
    fan_in: int, fan_out: int, scale: float, generator: torch.Generator | None
) -> nn.Linear:
    device = torch.get_default_device()
    layer = nn.utils.skip_init(nn.Linear, fan_in, fan_out, device=device)
    limit = math.sqrt(6 * scale / (fan_in + fan_out))
    nn.init.uniform_(layer.weight, -limit, limit, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer
