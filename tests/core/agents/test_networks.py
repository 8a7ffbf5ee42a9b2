"""The multilayer perceptron: activation, layer norm and initial weights of the reference."""

import math

from metagcttt_core import make_agent
from metagcttt_core.agents.networks import MLP
import numpy as np
import pytest
from tests.core.builders import DATA
import torch


def gelu(x: np.ndarray) -> np.ndarray:
    return 0.5 * x * (1 + np.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))


@pytest.mark.parametrize('layer_norm', [False, True])
def test_forward_pass_by_hand(layer_norm):
    """Linear, GELU (tanh form), layer norm after the activation, and a plain linear head."""
    generator = torch.Generator().manual_seed(3)
    network = MLP(3, (5, 4), 2, layer_norm=layer_norm, generator=generator).double()
    with torch.no_grad():
        for weight in network.parameters():
            weight.add_(torch.randn(weight.shape, generator=generator, dtype=torch.float64))
    inputs = np.random.default_rng(0).normal(size=(7, 3))
    weights = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    x = inputs
    for layer in range(2):
        x = gelu(x @ weights[f'fc{layer}.weight'].T + weights[f'fc{layer}.bias'])
        if layer_norm:
            mean = x.mean(axis=1, keepdims=True)
            variance = ((x - mean) ** 2).mean(axis=1, keepdims=True)
            x = (x - mean) / np.sqrt(variance + 1e-6)
            x = x * weights[f'ln{layer}.weight'] + weights[f'ln{layer}.bias']
    expected = x @ weights['out.weight'].T + weights['out.bias']
    with torch.no_grad():
        np.testing.assert_allclose(network(torch.from_numpy(inputs)), expected, rtol=1e-10)


@pytest.mark.parametrize('name', ['pm', 'ant'])
def test_initial_weights_have_the_reference_distribution(name):
    """Uniform kernels on the Glorot range, a hundredth of it for the actor's mean head."""
    obs_dim, act_dim = {'pm': (2, 2), 'ant': (29, 8)}[name]
    weights = make_agent('gciql', obs_dim=obs_dim, act_dim=act_dim).export_reference_parameters()
    with np.load(DATA / 'init_stats.npz') as golden:
        stats = {key: golden[key] for key in golden.files}
    checked = 0
    for number, layer in enumerate(stats['layer']):
        if not layer.startswith(f'{name}.'):
            continue
        own_name = layer.removeprefix(f'{name}.')
        for critic in (0, 1):
            if own_name.endswith(f'[{critic}]'):
                own_name = own_name[:-3].replace('critic', f'critic{critic + 1}')
        kernel = weights[own_name]
        assert kernel.shape == (stats['fan_in'][number], stats['fan_out'][number])
        assert np.abs(kernel).max() <= stats['limit'][number] * (1 + 1e-6)
        assert np.abs(kernel).max() > stats['limit'][number] * 0.98
        # Five standard errors of a uniform distribution's mean and standard deviation.
        expected = stats['expected_std'][number]
        assert abs(kernel.mean()) < 5 * expected / math.sqrt(kernel.size)
        assert abs(kernel.std() / expected - 1) < 5 * math.sqrt(0.2 / kernel.size)
        checked += 1
    assert checked == 16


def test_initial_biases_and_scales():
    weights = make_agent(
        'gciql', obs_dim=3, act_dim=2, hidden=(8, 8)
    ).export_reference_parameters()
    biases = [array for name, array in weights.items() if name.endswith('.bias')]
    scales = [array for name, array in weights.items() if name.endswith('.scale')]
    assert (len(biases), len(scales)) == (6 * 3 + 5 * 2, 5 * 2)
    assert not any(array.any() for array in biases)
    assert all((array == 1).all() for array in scales)
