from metagcttt_core import Agent, make_agent
from metagcttt_core.adaptation.weights import changed_weights, with_weights
import pytest
import safetensors.torch
import torch


@pytest.fixture
def base() -> Agent:
    return make_agent('gciql', obs_dim=2, act_dim=2, hidden=(8, 8), seed=0)


def changed(base: Agent, *names: str) -> Agent:
    agent = base.clone()
    with torch.no_grad():
        for name in names:
            agent.state_dict()[name].add_(0.125)
    return agent


def test_expert_comes_back_bit_for_bit_and_base_stays(base: Agent) -> None:
    before = base.fingerprint()
    names = [name for name in base.state_dict() if name.endswith('weight')]
    expert = changed(base, *names)
    copy = with_weights(base, changed_weights(base, expert))
    assert copy.fingerprint() == expert.fingerprint() != before
    assert base.fingerprint() == before


def test_only_what_differs_travels(base: Agent) -> None:
    name = next(iter(base.state_dict()))
    content = changed_weights(base, changed(base, name))
    assert [*safetensors.torch.load(content)] == [name]
    assert changed_weights(base, base.clone()) == b''


def test_false_weights_are_refused_by_name(base: Agent) -> None:
    name = next(iter(base.state_dict()))
    own = base.state_dict()[name]
    whole = changed_weights(base, changed(base, name))
    nan = own.clone()
    nan.view(-1)[0] = torch.nan
    for content, reason in (
        (b'', 'no safetensors file'),
        (b'no weights at all', 'no safetensors file'),
        (whole[:-1], 'no safetensors file'),
        (b'\xff' * 8 + whole[8:], 'no safetensors file'),
        (bytes(1 << 21), 'the policy has at most'),
        (safetensors.torch.save({'pilot': own}), "no weight 'pilot'"),
        (safetensors.torch.save({name: own.flatten()}), f'weight {name} is'),
        (safetensors.torch.save({name: own.double()}), f'weight {name} is torch.float64'),
        (safetensors.torch.save({name: nan}), f'weight {name} holds a non-finite value'),
    ):
        with pytest.raises(ValueError, match=reason):
            with_weights(base, content)
