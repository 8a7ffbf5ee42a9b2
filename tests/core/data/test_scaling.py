"""One scaling, applied wherever networks meet physical numbers, and undone on the way back."""

from hypothesis import given
from hypothesis import strategies as st
from metagcttt_core import (
    adapt,
    DatasetError,
    FilterConfig,
    load_checkpoint,
    make_agent,
    MetaConfig,
    post_train,
    save_checkpoint,
    TrajectoryDataset,
    TrajectoryFilter,
    TTTConfig,
)
from metagcttt_core.data import Scaling
from metagcttt_core.training.config import PretrainConfig
from metagcttt_core.training.pretrain import pretrain
import numpy as np
import pytest

UTM = np.array([389_512.0, 5_820_114.0])
PAPER = FilterConfig(variant='paper', epsilon=0.5)


def walk(origin=0.0, factor=1.0) -> TrajectoryDataset:
    """Ten trajectories of 30 rows, steps of a centimetre, actions up to `factor`."""
    rng = np.random.default_rng(0)
    steps = rng.uniform(-1, 1, (300, 2))
    # Sixteenths of a millimetre, which doubles hold exactly with and without the origin.
    places = np.round(np.cumsum(steps, axis=0) * 160) / 16_384
    ends = np.arange(300) % 30 == 29
    return TrajectoryDataset.from_arrays(places + origin, (factor * steps), ends)


def agent_for(dataset: TrajectoryDataset, name: str = 'gcbc', *, standardise: bool = False):
    agent = make_agent(name, obs_dim=2, act_dim=2, hidden=(16,))
    agent.scaling = Scaling.of(dataset, standardise=standardise)
    return agent


@given(st.lists(st.floats(-50, 50, width=32), min_size=2, max_size=2), st.floats(1, 50))
def test_actions_come_back(values, limit):
    scaling = Scaling.identity(2, 2)
    scaling = Scaling(scaling.origin, scaling.mean, scaling.std, np.full(2, limit))
    actions = np.array(values, np.float32)
    np.testing.assert_allclose(
        scaling.physical_actions(scaling.actions(actions)), actions, 1e-5, 1e-5
    )


def test_standardised_observations_have_mean_0_and_deviation_1():
    dataset = walk(UTM)
    seen = agent_for(dataset, standardise=True).scaling.observations(dataset.states(slice(None)))
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(seen.std(0), 1, atol=1e-5)


def test_value_that_never_changes_keeps_its_deviation():
    dataset = TrajectoryDataset.from_arrays(np.full((3, 1), 7.0), np.zeros((3, 1)), [0, 0, 1])
    scaling = Scaling.of(dataset, standardise=True)
    assert (scaling.mean.item(), scaling.std.item()) == (7.0, 1.0)


def test_ordinary_data_are_left_alone_in_bits():
    dataset = walk()
    assert Scaling.of(dataset).is_identity
    assert Scaling.identity(2, 2).observations(dataset.observations) is dataset.observations
    assert dataset.states(slice(None)).dtype == np.float32


@pytest.mark.parametrize('name', ['crl', 'gcbc', 'gciql', 'saw'])
def test_everything_is_the_same_far_from_the_origin(name, tmp_path):
    """Pre-training, post-training, retrieval, adaptation and acting, after a checkpoint."""
    found = []
    for origin in (0.0, UTM):
        dataset = walk(origin)
        middle = np.rint(dataset.observations.min(0) / 2 + dataset.observations.max(0) / 2)
        agent = agent_for(dataset, name, standardise=True)
        if not np.any(origin):  # counted from the same place as the other
            far = walk(UTM)
            shift = far.origin - UTM
            agent.scaling = Scaling(
                shift, agent.scaling.mean - shift, agent.scaling.std, agent.scaling.limit
            )
            assert np.abs(middle).max() < 2
        agent = pretrain(agent, dataset, PretrainConfig(steps=3, batch_size=32))
        meta = MetaConfig(
            algorithm='reptile', outer_steps=2, inner_steps=2, batch_size=16, filter=PAPER
        )
        agent = post_train(agent, dataset, meta)
        save_checkpoint(agent, tmp_path / 'policy')
        agent = load_checkpoint(tmp_path / 'policy')
        state, goal = dataset.states(3), dataset.states(20)
        support = TrajectoryFilter(dataset, PAPER).query(state, goal, agent.value_fn)
        expert = adapt(agent, dataset, support, goal, TTTConfig(steps=3, batch_size=16)).agent
        found.append((support.indices.tolist(), expert.act(state, goal)))
    assert found[0][0] == found[1][0] != []
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=2e-3, atol=1e-4)


def test_dataset_far_from_the_origin_is_written_in_its_own_units(tmp_path):
    dataset = walk(UTM)
    assert dataset.origin.all()
    dataset.save(tmp_path / 'utm.npz')
    again = TrajectoryDataset.load(tmp_path / 'utm.npz')
    assert again.fingerprint == dataset.fingerprint
    with np.load(tmp_path / 'utm.npz') as file:
        np.testing.assert_array_equal(file['observations'], dataset.states(slice(None)))


def test_actions_beyond_1_are_learned_in_their_own_units():
    plain = walk()
    actions = np.full((300, 2), (3.0, -0.5))
    dataset = TrajectoryDataset.from_arrays(plain.observations, actions, plain.terminals)
    agent = agent_for(dataset)
    agent = pretrain(agent, dataset, PretrainConfig(steps=200, batch_size=64, lr=1e-2))
    acts = agent.act(dataset.observations[3], dataset.observations[20])
    np.testing.assert_allclose(acts, (3.0, -0.5), atol=0.2)
    assert np.abs(agent.act(np.full(2, 1e6), np.full(2, -1e6))).max() <= 3.0


@pytest.mark.parametrize(
    ('dataset', 'message'),
    [
        (walk(factor=3.0), r'actions\[:, 0\] reach 3, .*limit of the policy, 1'),
        (walk(UTM), 'near'),
    ],
    ids=['actions', 'origin'],
)
def test_data_outside_the_scaling_are_refused(dataset, message):
    agent = make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(8,))
    support = TrajectoryFilter(dataset, PAPER).query(dataset.states(3), dataset.states(20))
    goal = dataset.states(20)
    for start in (
        lambda: pretrain(agent, dataset, PretrainConfig(steps=1, batch_size=8)),
        lambda: post_train(agent, dataset, MetaConfig(outer_steps=1, filter=PAPER)),
        lambda: adapt(agent, dataset, support, goal, TTTConfig(steps=1, batch_size=8)),
    ):
        with pytest.raises(DatasetError, match=message):
            start()


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'std': [1.0, 0.0]}, 'std must be at least 1e-15'),
        ({'std': [1.0, 1e-320]}, 'std must be at least 1e-15'),
        ({'mean': [1.0]}, 'mean must be 2 numbers'),
        ({'origin': [0.0, -1e308]}, r'origin must be 2 numbers within 1e\+15'),
        ({'limit': [1.0, 1e300]}, r'limit must be 2 numbers within 1e\+15'),
        ({'std': [1.0, 10**400]}, r'std must be 2 numbers \(int too large'),
        ({'mean': ['a', 0.0]}, r'mean must be 2 numbers \(could not'),
        ({'other': [1.0]}, 'scaling needs origin, mean, std, limit'),
    ],
)
def test_damaged_scaling_is_refused(change, message):
    plain = Scaling.identity(2, 2).to_json()
    with pytest.raises(ValueError, match=message):
        Scaling.from_json(plain | change, 2, 2)


def test_contract_travels_with_the_dataset(tmp_path):
    contract = {'robot': 'cart', 'fingerprint': '0123456789abcdef'}
    data = TrajectoryDataset.from_arrays(np.zeros((2, 1)), np.zeros((2, 1)), [0, 1])
    data.save(tmp_path / 'plain.npz')
    assert TrajectoryDataset.load(tmp_path / 'plain.npz').contract is None
    data = TrajectoryDataset.from_arrays(
        data.observations, data.actions, data.terminals, contract=contract
    )
    data.save(tmp_path / 'robot.npz')
    assert TrajectoryDataset.load(tmp_path / 'robot.npz').contract == contract
    marks = [TrajectoryDataset.load(tmp_path / f'{name}.npz') for name in ('plain', 'robot')]
    assert marks[0].fingerprint != marks[1].fingerprint == data.fingerprint


@pytest.mark.parametrize('text', ['[1]', '{', np.zeros(2)])
def test_contract_that_is_none_is_refused(text, tmp_path):
    rows = {'observations': np.zeros((2, 1)), 'actions': np.zeros((2, 1)), 'terminals': [0, 1]}
    np.savez(tmp_path / 'bad.npz', contract=np.array(text), **rows)
    with pytest.raises(DatasetError, match='contract'):
        TrajectoryDataset.load(tmp_path / 'bad.npz')
