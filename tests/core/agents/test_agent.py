"""What every agent offers: acting, copying, and exchanging weights with the reference."""

import math

from metagcttt_core import DatasetError, make_agent, TrajectoryDataset
import numpy as np
from pydantic import ValidationError
import pytest
from tests.core.builders import (
    assert_bit_equal,
    assert_changed,
    EVERY_AGENT,
    random_dataset,
    tiny_agent,
    weights_of,
)
import torch


def mean_of(agent, observation, goal) -> np.ndarray:
    """The unclipped mean of the policy."""
    inputs = np.concatenate([observation, goal], axis=-1).astype(np.float32)
    with torch.no_grad():
        return agent.actor(torch.from_numpy(inputs)).numpy()


@pytest.fixture
def states() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(8, 2))


@EVERY_AGENT
def test_action_is_the_mean_clipped(name, states):
    agent = tiny_agent(name)
    with torch.no_grad():
        agent.actor.get_submodule('mean').weight.mul_(6)
    goal = np.array([0.5, -0.5])
    expected = mean_of(agent, states, np.tile(goal, (8, 1)))
    assert (np.abs(expected) > 1).any()
    assert (np.abs(expected) < 1).any()
    actions = agent.act(states, goal)
    np.testing.assert_allclose(actions, np.clip(expected, -1, 1), rtol=1e-6)
    assert (actions.shape, actions.dtype) == ((8, 2), np.float32)
    assert np.abs(actions).max() == 1


def test_one_observation_and_a_batch_agree(states):
    agent = tiny_agent()
    goals = states[::-1].copy()
    batch = agent.act(states, goals)
    for state, goal, action in zip(states, goals, batch, strict=True):
        single = agent.act(state, goal)
        assert single.shape == (2,)
        np.testing.assert_allclose(single, action, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(
        agent.act(states, goals[0])[3], agent.act(states[3], goals[0]), rtol=1e-5, atol=1e-7
    )


def test_acting_is_deterministic_and_leaves_no_trace(states):
    agent = tiny_agent()
    weights = weights_of(agent)
    first = agent.act(states, states)
    torch.manual_seed(1)
    assert np.array_equal(agent.act(states, states), first)
    assert_bit_equal(agent, weights)
    # The actions are ordinary arrays: writing to them does not reach the agent.
    first[:] = 9
    assert not np.array_equal(agent.act(states, states), first)


@pytest.mark.parametrize('const_std', [True, False])
def test_temperature_scales_the_noise(const_std):
    agent = tiny_agent(const_std=const_std)
    with torch.no_grad():
        agent.actor.get_submodule('mean').weight.mul_(0.01)
        agent.actor.get_submodule('mean').bias.zero_()
        if not const_std:
            agent.actor.log_stds.copy_(torch.tensor([math.log(0.5), math.log(2.0)]))
    states = np.zeros((20_000, 2))
    actions = agent.act(states, states, temperature=0.1, rng=np.random.default_rng(0))
    expected = [0.1, 0.1] if const_std else [0.05, 0.2]
    np.testing.assert_allclose(actions.std(axis=0), expected, rtol=0.03)
    again = agent.act(states, states, temperature=0.1, rng=np.random.default_rng(0))
    assert np.array_equal(actions, again)
    assert (
        np.abs(agent.act(states, states, temperature=9.0, rng=np.random.default_rng(0))).max() == 1
    )


def test_temperature_without_a_generator_is_refused():
    with pytest.raises(ValueError, match='a temperature above 0 needs an rng'):
        tiny_agent().act(np.zeros(2), np.zeros(2), temperature=0.5)


@pytest.mark.parametrize('field', ['observation', 'goal'])
@pytest.mark.parametrize(
    ('value', 'message'),
    [
        (np.zeros(3), r'must have shape \(2,\) or \(n, 2\), got \(3,\)'),
        (np.zeros((4, 3)), r'must have shape \(2,\) or \(n, 2\), got \(4, 3\)'),
        (np.zeros((1, 1, 2)), r'must have shape \(2,\) or \(n, 2\), got \(1, 1, 2\)'),
        (np.float64(0), r'must have shape \(2,\) or \(n, 2\), got \(\)'),
        (np.array([0, np.nan]), 'holds a non-finite value'),
        (np.array([[0, 0], [np.inf, 0]]), 'holds a non-finite value'),
    ],
)
def test_wrong_input_is_refused_by_name(field, value, message):
    with pytest.raises(ValueError, match=f'^{field} {message}'):
        tiny_agent().act(**{'observation': np.zeros(2), 'goal': np.zeros(2), field: value})


@pytest.mark.parametrize(('shape', 'goal_shape'), [((3, 2), (4, 2)), ((2,), (4, 2))])
def test_goal_that_does_not_fit_the_observation_is_refused(shape, goal_shape):
    with pytest.raises(ValueError, match=r'goal of shape .* does not fit observation of shape'):
        tiny_agent().act(np.zeros(shape), np.zeros(goal_shape))


@EVERY_AGENT
def test_clone_is_equal_and_independent(name):
    agent = tiny_agent(name)
    agent.metadata = {'history': [{'stage': 'pretrain'}]}
    weights = weights_of(agent)
    copy = agent.clone()
    assert_bit_equal(copy, weights)
    with torch.no_grad():
        for weight in copy.parameters():
            weight.add_(1)
    copy.metadata['history'].append({'stage': 'post_train'})
    assert_bit_equal(agent, weights)
    assert_changed(copy, weights)
    assert agent.metadata == {'history': [{'stage': 'pretrain'}]}


@EVERY_AGENT
@pytest.mark.parametrize('const_std', [True, False])
def test_exported_parameters_import_into_another_agent(name, const_std):
    source = tiny_agent(name, seed=1, const_std=const_std)
    target = tiny_agent(name, seed=2, const_std=const_std)
    assert_changed(target, weights_of(source))
    target.import_reference_parameters(source.export_reference_parameters())
    assert_bit_equal(target, weights_of(source))


def test_exported_parameters_have_reference_names_and_shapes():
    exported = tiny_agent('gciql', obs_dim=3).export_reference_parameters()
    assert exported['actor.fc0.kernel'].shape == (6, 6)
    assert exported['actor.mean.kernel'].shape == (6, 2)
    assert exported['value.ln0.scale'].shape == (6,)
    assert exported['target2.fc0.kernel'].shape == (8, 6)
    assert exported['critic1.out.bias'].shape == (1,)
    assert not any(name.startswith('actor.ln') for name in exported)


def test_exported_parameters_are_copies():
    agent = tiny_agent()
    weights = weights_of(agent)
    for array in agent.export_reference_parameters().values():
        array += 1
    assert_bit_equal(agent, weights)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda p: p.pop('actor.fc0.bias'), r"missing \['actor.fc0.bias'\], unknown none"),
        (lambda p: p.update({'actor.fc9.bias': 0}), r"missing none, unknown \['actor.fc9.bias'\]"),
        (
            lambda p: p.update({'actor.fc0.kernel': np.zeros((6, 5))}),
            r'actor.fc0.kernel must have shape \(4, 6\), got \(6, 5\)',
        ),
        (
            lambda p: p.update({'actor.mean.bias': np.array([1, np.nan])}),
            'actor.mean.bias holds a non-finite value',
        ),
    ],
)
def test_wrong_reference_parameters_are_refused_and_change_nothing(change, message):
    agent = tiny_agent()
    weights = weights_of(agent)
    parameters = tiny_agent(seed=5).export_reference_parameters()
    change(parameters)
    with pytest.raises(ValueError, match=message):
        agent.import_reference_parameters(parameters)
    assert_bit_equal(agent, weights)


@EVERY_AGENT
def test_initial_weights_depend_on_the_seed_alone(name):
    torch.manual_seed(0)
    first = make_agent(name, obs_dim=2, act_dim=2, hidden=(4,), seed=3)
    torch.manual_seed(1)
    assert_bit_equal(
        make_agent(name, obs_dim=2, act_dim=2, hidden=(4,), seed=3), weights_of(first)
    )
    assert_changed(make_agent(name, obs_dim=2, act_dim=2, hidden=(4,), seed=4), weights_of(first))


def test_default_network_is_the_published_one():
    agent = make_agent('gcbc', obs_dim=29, act_dim=8)
    shapes = {name: tuple(tensor.shape) for name, tensor in agent.state_dict().items()}
    assert shapes == {
        'actor.fc0.weight': (512, 58),
        'actor.fc0.bias': (512,),
        'actor.fc1.weight': (512, 512),
        'actor.fc1.bias': (512,),
        'actor.fc2.weight': (512, 512),
        'actor.fc2.bias': (512,),
        'actor.mean.weight': (8, 512),
        'actor.mean.bias': (8,),
    }


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (
            {'name': 'gcbb'},
            "unknown agent 'gcbb'; did you mean 'gcbc'\\? \\(known: crl, gcbc, gciql, saw\\)",
        ),
        ({'obs_dim': 0}, 'obs_dim must be at least 1, got 0'),
        ({'act_dim': -1}, 'act_dim must be at least 1, got -1'),
        ({'hidden': ()}, 'hidden\n.*at least 1'),
        ({'hidden': (8, 0)}, 'hidden.1\n.*greater than 0'),
        ({'discount': 1.0}, 'discount\n.*less than 1'),
        ({'discont': 0.9}, "no setting 'discont'; did you mean 'discount'"),
    ],
)
def test_wrong_settings_are_refused(arguments, message):
    with pytest.raises((ValueError, ValidationError), match=message):
        make_agent(**{'name': 'gcbc', 'obs_dim': 2, 'act_dim': 2, **arguments})


@EVERY_AGENT
def test_actor_only_trains_the_actor_alone(name):
    agent = tiny_agent(name, const_std=False)
    everything = {id(weight) for weight in agent.trained_parameters()}
    actor = {id(weight) for weight in agent.trained_parameters(actor_only=True)}
    assert actor == {id(weight) for weight in agent.actor.parameters()}
    assert id(agent.actor.log_stds) in actor
    assert actor <= everything
    assert (actor == everything) == (name == 'gcbc')


def test_batch_becomes_tensors_of_the_same_values():
    batch = {'observations': np.arange(6, dtype=np.float32).reshape(3, 2)[:, ::-1]}
    tensors = tiny_agent().tensors(batch)
    assert tensors['observations'].tolist() == batch['observations'].tolist()
    assert tensors['observations'].dtype == torch.float32


def test_fingerprint_tells_policies_apart_that_act_or_adapt_differently():
    def fingerprint(state=None, **settings):
        agent = tiny_agent('gciql', **settings)
        agent.optimizer_state = state
        return agent.fingerprint()

    different = [
        fingerprint(),
        fingerprint(discount=0.9),
        fingerprint(expectile=0.8),
        fingerprint(alpha=7.0),
        fingerprint(actor_loss='bc'),
        fingerprint({0: {'exp_avg': torch.zeros(2)}}),
        fingerprint({0: {'exp_avg': torch.ones(2)}}),
        tiny_agent('gciql', seed=1).fingerprint(),
    ]
    assert len(set(different)) == len(different)
    assert fingerprint() == fingerprint()
    assert tiny_agent('gciql').clone().fingerprint() == fingerprint()


@pytest.mark.parametrize(
    ('change', 'fault'),
    [
        (
            {'obs_dim': 3},
            'the agent is for observations of 2 and actions of 2 values, the dataset has 3 and 2',
        ),
        ({'act_dim': 1}, 'values, the dataset has 2 and 1'),
        (
            {'contract': {'robot': 'van', 'fingerprint': 'a'}},
            r'the dataset was made for van \(contract a\), not for cart \(contract b\), as',
        ),
        ({'scale': 3}, r'dataset: actions\[:, 0\] reach .*, beyond the limit of the policy, 1'),
    ],
)
def test_data_for_another_policy_are_refused(change, fault):
    agent = tiny_agent()
    agent.metadata['contract'] = {'robot': 'cart', 'fingerprint': 'b'}
    agent.check(random_dataset([9]))
    widths = {name: width for name, width in change.items() if name.endswith('dim')}
    data = random_dataset([9], **widths)
    data.contract = change.get('contract')
    if scale := change.get('scale'):
        data = TrajectoryDataset.from_arrays(
            data.observations, scale * data.actions, data.terminals
        )
    with pytest.raises(DatasetError, match=fault):
        agent.check(data)
