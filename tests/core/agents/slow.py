"""Networks for one input at a time, from exported arrays, in double precision."""

import math

import numpy as np
from tests.core.builders import random_dataset


def batch_of(agent, size: int):
    dataset = random_dataset([40, 30], obs_dim=agent.obs_dim, act_dim=agent.act_dim)
    return agent.relabeller(dataset).sample(size, np.random.default_rng(0))


class SlowNetworks:
    """The multilayer perceptrons of an agent."""

    def __init__(self, agent):
        self.w = {k: v.astype(np.float64) for k, v in agent.export_reference_parameters().items()}
        self.s = agent.settings

    def mlp(self, net, x, head, norm):
        for layer in range(len(self.s.hidden)):
            x = x @ self.w[f'{net}.fc{layer}.kernel'] + self.w[f'{net}.fc{layer}.bias']
            x = 0.5 * x * (1 + np.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))
            if norm:
                x = (x - x.mean()) / math.sqrt(x.var() + 1e-6)
                x = x * self.w[f'{net}.ln{layer}.scale'] + self.w[f'{net}.ln{layer}.bias']
        return x @ self.w[f'{net}.{head}.kernel'] + self.w[f'{net}.{head}.bias']
