"""The yardstick of the inner-loop benchmark: the steps in JAX, as one compiled scan."""

from collections.abc import Callable, Mapping
from typing import Any

from metagcttt_core.agents.config import GCIQLSettings
import numpy as np

Arrays = Mapping[str, np.ndarray]


def jax_inner_loop(
    weights: Arrays, batches: Arrays, lr: float, settings: GCIQLSettings | None = None
) -> Callable[[], list[float]]:
    """A function that takes Adam's steps and returns the loss before each, up to a constant.

    Args:
        weights: As `Agent.export_reference_parameters` names them.
        batches: What `Agent.losses` takes, with an axis of steps in front.
        lr: Learning rate.
        settings: Of GCIQL with the actor loss `ddpgbc`; without them the agent is GCBC.
    """
    import jax
    from jax import numpy as jnp

    def network(name: str, weights: Any, *parts: Any) -> Any:
        x = jnp.concatenate(parts, axis=-1)
        layer = 0
        while f'{name}.fc{layer}.kernel' in weights:
            fc, ln = f'{name}.fc{layer}', f'{name}.ln{layer}'
            x = jax.nn.gelu(x @ weights[f'{fc}.kernel'] + weights[f'{fc}.bias'])
            if f'{ln}.scale' in weights:
                centered = x - x.mean(-1, keepdims=True)
                variance = jnp.square(centered).mean(-1, keepdims=True)
                x = centered * jax.lax.rsqrt(variance + 1e-6)
                x = x * weights[f'{ln}.scale'] + weights[f'{ln}.bias']
            layer += 1
        head = 'mean' if name == 'actor' else 'out'
        return x @ weights[f'{name}.{head}.kernel'] + weights[f'{name}.{head}.bias']

    def smaller(names: tuple[str, str], weights: Any, *parts: Any) -> Any:
        return jnp.minimum(*(network(name, weights, *parts) for name in names)).squeeze(-1)

    def actor_loss(weights: Any, batch: Any) -> Any:
        states = batch['observations'], batch['actor_goals']
        mean = network('actor', weights, *states)
        bc = 0.5 * jnp.square(batch['actions'] - mean).sum(-1).mean()
        if settings is None:
            return bc
        frozen = jax.lax.stop_gradient(weights)
        q = smaller(('critic1', 'critic2'), frozen, *states, mean.clip(-1, 1))
        return -q.mean() / (jax.lax.stop_gradient(jnp.abs(q).mean()) + 1e-6) + settings.alpha * bc

    def loss_of(weights: Any, targets: Any, batch: Any) -> Any:
        actor = actor_loss(weights, batch)
        if settings is None:
            return actor
        states = batch['observations'], batch['value_goals']
        q = smaller(('target1', 'target2'), targets, *states, batch['actions'])
        error = q - network('value', weights, *states).squeeze(-1)
        side = jnp.where(error >= 0, settings.expectile, 1 - settings.expectile)
        value = (side * jnp.square(error)).mean()
        following = network('value', weights, batch['next_observations'], batch['value_goals'])
        target = jax.lax.stop_gradient(
            batch['rewards'] + settings.discount * batch['masks'] * following.squeeze(-1)
        )
        critics = [
            network(name, weights, *states, batch['actions']).squeeze(-1)
            for name in ('critic1', 'critic2')
        ]
        critic = jnp.square(jnp.stack(critics) - target).sum(0).mean()
        return value + critic + actor

    def step(carry: Any, batch: Any) -> Any:
        weights, targets, means, squares, count = carry
        loss, slopes = jax.value_and_grad(loss_of)(weights, targets, batch)
        if settings is not None:
            targets = {
                name: target + settings.tau * (weights[name.replace('target', 'critic')] - target)
                for name, target in targets.items()
            }
        count += 1
        means = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, means, slopes)
        squares = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, squares, slopes)

        def moved(w: Any, m: Any, v: Any) -> Any:
            return w - lr * (m / (1 - 0.9**count)) / (jnp.sqrt(v / (1 - 0.999**count)) + 1e-8)

        weights = jax.tree.map(moved, weights, means, squares)
        return (weights, targets, means, squares, count), loss

    targets = {name: array for name, array in weights.items() if name.startswith('target')}
    trained = {name: array for name, array in weights.items() if name not in targets}
    zeros = {name: np.zeros_like(array) for name, array in trained.items()}
    scan = jax.jit(lambda carry, batches: jax.lax.scan(step, carry, batches))
    start = (trained, targets, zeros, zeros, np.float32(0))
    return lambda: scan(start, dict(batches))[1].tolist()
