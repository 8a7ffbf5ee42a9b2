"""Copies of modules against `copy.deepcopy`, its slow reference."""

import copy

from metagcttt_core.agents.copying import copied
import pytest
from tests.core.builders import EVERY_AGENT, tiny_agent
import torch
from torch import nn
from torch.nn.utils.parametrizations import orthogonal


class Odd(nn.Module):
    """What modules may hold: ties, buffers, hooks, modules twice and in lists, attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Linear(3, 3, dtype=torch.float64)
        self.second = nn.Linear(3, 3, dtype=torch.float64)
        self.second.weight = self.first.weight
        self.again = self.first
        self.missing = None
        self.register_module('none', None)
        self.register_parameter('absent', None)
        self.register_buffer('kept', torch.arange(3.0))
        self.register_buffer('dropped', torch.arange(2.0), persistent=False)
        self.first.register_forward_hook(hook)
        self.frozen = nn.Parameter(torch.ones(2), requires_grad=False)
        self.tensor = torch.zeros(2)
        self.aside = [self.first, {'weight': self.first.weight}]
        self.frozen.grad = torch.ones(2)
        self.second.eval()


def hook(module, inputs, output):
    return 2 * output


def module(name: str) -> nn.Module:
    torch.manual_seed(0)
    if name == 'odd':
        return Odd()
    if name == 'recurrent':
        return nn.GRU(3, 3)  # keeps a list of its weights
    return orthogonal(nn.Linear(3, 3))  # copies itself in a way of its own


@pytest.mark.parametrize('name', ['odd', 'recurrent', 'parametrized'])
def test_copy_is_that_of_deepcopy(name):
    original = module(name)
    ours, reference = copied(original, {}), copy.deepcopy(original)
    assert repr(ours) == repr(reference)
    assert ours.state_dict().keys() == reference.state_dict().keys()
    for kind in ('named_parameters', 'named_buffers', 'named_modules'):
        ours_parts, parts = dict(getattr(ours, kind)()), dict(getattr(reference, kind)())
        assert ours_parts.keys() == parts.keys()
        originals = {id(part) for part in dict(getattr(original, kind)()).values()}
        assert not originals & {id(part) for part in ours_parts.values()}
    for weight, same in zip(ours.parameters(), reference.parameters(), strict=True):
        assert torch.equal(weight, same) and weight.requires_grad == same.requires_grad
    for part, same in zip(ours.modules(), reference.modules(), strict=True):
        assert type(part) is type(same) and part.training == same.training
        assert vars(part).keys() == vars(same).keys()
        assert list(vars(part)['_modules']) == list(vars(same)['_modules'])
        assert part._non_persistent_buffers_set == same._non_persistent_buffers_set


def test_what_is_shared_stays_shared_within_the_copy():
    original = Odd()
    ours = copied(original, {})
    assert ours.second.weight is ours.first.weight is ours.aside[1]['weight']
    assert ours.again is ours.first is ours.aside[0]
    assert ours.tensor is not original.tensor
    inputs = torch.ones(3, dtype=torch.float64)
    assert torch.equal(ours.first(inputs), original.first(inputs))  # hooks too
    ours.first.register_forward_hook(hook)
    assert torch.equal(ours.first(inputs), 2 * original.first(inputs))


def test_what_the_memo_holds_is_taken_as_it_is():
    original = Odd()
    ours = copied(original, {id(original.first): original.second, id(original.tensor): 'given'})
    assert ours.first is ours.again is original.second and ours.tensor == 'given'


@EVERY_AGENT
def test_agents_take_the_short_way(name, monkeypatch):
    agent = tiny_agent(name)
    copies = []
    monkeypatch.setattr(copy, 'deepcopy', lambda part, memo: copies.append(part))
    copied(agent, {})
    assert not any(isinstance(part, nn.Module) for part in copies)
