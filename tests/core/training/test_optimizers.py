"""The optimisers: torch's own results, and what they leave untouched."""

from metagcttt_core.kernels import load_kernels
from metagcttt_core.training.optimizers import KernelAdam, make_optimizer
import pytest
import torch
from torch import nn


def stepped(optimizer, weight: nn.Parameter, gradients) -> torch.Tensor:
    for gradient in gradients:
        weight.grad = gradient.clone()
        optimizer.step()
    return weight.detach().clone()


GRADIENTS = [torch.tensor([0.5, -2.0, 1e-4]), torch.tensor([-0.1, 3.0, 2e-4])]


@pytest.mark.parametrize(
    ('name', 'reference'), [('adam', torch.optim.Adam), ('sgd', torch.optim.SGD)]
)
def test_steps_equal_torch(name, reference):
    ours, theirs = (nn.Parameter(torch.tensor([1.0, -1.0, 0.5])) for _ in range(2))
    result = stepped(make_optimizer(name, [ours], 0.1), ours, GRADIENTS)
    expected = stepped(reference([theirs], lr=0.1), theirs, GRADIENTS)
    torch.testing.assert_close(result, expected, rtol=1e-6, atol=1e-7)


def test_adam_by_hand():
    """Eps is added after bias correction, outside the square root."""
    weight = nn.Parameter(torch.tensor([1.0]))
    result = stepped(make_optimizer('adam', [weight], 0.1), weight, [torch.tensor([1e-8])])
    assert result.item() == pytest.approx(1 - 0.1 * 1e-8 / (1e-8 + 1e-8), rel=1e-6)


def test_given_state_is_used_and_not_changed():
    first = nn.Parameter(torch.zeros(3))
    optimizer = make_optimizer('adam', [first], 0.1)
    stepped(optimizer, first, GRADIENTS)
    state = optimizer.state_dict()['state']
    before = {key: tensor.clone() for key, tensor in state[0].items()}
    results = []
    for _ in range(2):
        weight = nn.Parameter(first.detach().clone())
        results.append(stepped(make_optimizer('adam', [weight], 0.1, state), weight, GRADIENTS))
    assert torch.equal(results[0], results[1])
    assert all(torch.equal(state[0][key], tensor) for key, tensor in before.items())
    assert torch.equal(results[0], stepped(optimizer, first, GRADIENTS))


@pytest.mark.parametrize('taken', [0, 3])
def test_one_call_for_all_weights_steps_and_counts_as_torch(taken):
    """The state stays torch's own: saved, given to another optimiser, and stepped further."""
    kernels = load_kernels()
    generator = torch.Generator().manual_seed(0)
    ours, theirs = [
        [nn.Parameter(torch.linspace(-1, 1, size)) for size in (5, 1, 3)] for _ in range(2)
    ]
    optimizers = [make_optimizer('adam', each, 0.1) for each in (ours, theirs)]
    quick = None
    for step in range(6):
        for pair in zip(ours, theirs, strict=True):
            gradient = torch.randn(pair[0].shape, generator=generator)
            for parameter in pair:
                if parameter.grad is None:
                    parameter.grad = torch.empty_like(parameter)
                parameter.grad.copy_(gradient)
        if step == taken:
            quick = KernelAdam(optimizers[0], kernels)
        optimizers[1].step()
        (optimizers[0] if quick is None or step == 5 else quick).step()
    states = [optimizer.state_dict()['state'] for optimizer in optimizers]
    assert [float(state['step']) for state in states[0].values()] == [6, 6, 6]
    for number, state in states[1].items():
        torch.testing.assert_close(states[0][number], state)
    for weight, same in zip(ours, theirs, strict=True):
        torch.testing.assert_close(weight, same)
