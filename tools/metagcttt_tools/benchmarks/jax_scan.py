"""The yardstick of the inner-loop benchmark: GCBC's steps in JAX, as one compiled scan."""

from collections.abc import Callable
from typing import Any

import numpy as np


def jax_inner_loop(
    weights: list[np.ndarray], inputs: np.ndarray, actions: np.ndarray, lr: float
) -> Callable[[], list[float]]:
    """A function that takes Adam's steps and returns the loss before each, up to a constant.

    Args:
        weights: Kernel (fan_in, fan_out) and bias of each layer, in turn.
        inputs: (K, B, in_dim) observations and goals of each step.
        actions: (K, B, act_dim).
        lr: Learning rate.
    """
    import jax
    from jax import numpy as jnp

    def loss_of(weights: Any, inputs: Any, actions: Any) -> Any:
        x = inputs
        for kernel, bias in zip(weights[:-2:2], weights[1:-2:2], strict=True):
            x = jax.nn.gelu(x @ kernel + bias)
        return 0.5 * jnp.square(x @ weights[-2] + weights[-1] - actions).sum(-1).mean()

    def step(carry: Any, batch: Any) -> Any:
        weights, means, squares, count = carry
        loss, gradients = jax.value_and_grad(loss_of)(weights, *batch)
        count += 1
        means = [0.9 * m + 0.1 * g for m, g in zip(means, gradients, strict=True)]
        squares = [0.999 * v + 0.001 * g * g for v, g in zip(squares, gradients, strict=True)]
        weights = [
            w - lr * (m / (1 - 0.9**count)) / (jnp.sqrt(v / (1 - 0.999**count)) + 1e-8)
            for w, m, v in zip(weights, means, squares, strict=True)
        ]
        return (weights, means, squares, count), loss

    zeros = [np.zeros_like(weight) for weight in weights]
    scan = jax.jit(lambda carry, batches: jax.lax.scan(step, carry, batches))
    return lambda: scan((weights, zeros, zeros, np.float32(0)), (inputs, actions))[1].tolist()
