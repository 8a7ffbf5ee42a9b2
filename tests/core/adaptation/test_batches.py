"""QueryBatches: which transitions and which goals adapt the policy."""

from metagcttt_core import TrajectoryDataset
from metagcttt_core.adaptation import batches as batches_module
from metagcttt_core.adaptation.batches import QueryBatches
import numpy as np
import pytest
from tests.core.builders import terminals_of, tiny_agent
import torch

GOAL = np.array([-7.0])


@pytest.fixture
def dataset() -> TrajectoryDataset:
    """Three trajectories of ten rows whose observations are the numbers of the rows."""
    numbers = np.arange(30, dtype=np.float32)[:, None]
    return TrajectoryDataset.from_arrays(numbers, -numbers, terminals_of([10, 10, 10]))


def batches_of(dataset, rows, name: str = 'gciql', **settings) -> QueryBatches:
    agent = tiny_agent(name, obs_dim=1, act_dim=1)
    return QueryBatches(agent, dataset, np.array(rows), GOAL, **settings)


def rows_of(batch) -> np.ndarray:
    return batch['observations'][:, 0].numpy().astype(int)


def test_by_default_every_row_is_from_the_support_and_every_actor_goal_is_the_query(dataset):
    batch = batches_of(dataset, [11, 12, 15]).sample(300, np.random.default_rng(0))
    rows = rows_of(batch)
    assert set(rows) == {11, 12, 15}
    assert (batch['actor_goals'] == -7).all()
    assert (batch['actions'][:, 0].numpy() == -rows).all()
    assert (batch['next_observations'][:, 0].numpy() == rows + 1).all()


def test_value_goals_rewards_and_masks_stay_relabelled(dataset):
    batch = batches_of(dataset, [11, 12, 15]).sample(3000, np.random.default_rng(0))
    value_goals = batch['value_goals'][:, 0].numpy()
    assert not (value_goals == -7).any()
    own = value_goals == rows_of(batch)
    assert own.mean() == pytest.approx(0.2, abs=0.04)
    assert np.array_equal(batch['rewards'], np.where(own, 0, -1))
    assert np.array_equal(batch['masks'], np.where(own, 0, 1))


def test_support_rows_are_drawn_uniformly_with_replacement(dataset):
    batch = batches_of(dataset, [1, 2, 3, 4, 5]).sample(5000, np.random.default_rng(1))
    counts = np.bincount(rows_of(batch), minlength=6)[1:]
    assert counts.sum() == 5000
    assert abs(counts - 1000).max() < 150


def test_rows_without_a_successor_are_never_drawn(dataset):
    batches = batches_of(dataset, [8, 9, 19, 29])
    assert batches.rows.tolist() == [8]
    assert set(rows_of(batches.sample(50, np.random.default_rng(0)))) == {8}
    assert rows_of(batches.all(np.random.default_rng(0))).tolist() == [8]


@pytest.mark.parametrize(('ratio', 'expected'), [(0.0, 0), (0.25, 10), (0.5, 20), (0.99, 39)])
def test_ratio_is_the_share_of_the_batch_from_the_support(dataset, ratio, expected):
    """The rest of the batch comes from all data and keeps its relabelled goals."""
    batches = batches_of(dataset, [25], ratio=ratio)
    everywhere = []
    for seed in range(20):
        batch = batches.sample(40, np.random.default_rng(seed))
        fixed = batch['actor_goals'][:, 0].numpy() == -7
        assert fixed.sum() == expected
        assert set(rows_of(batch)[fixed]) <= {25}
        everywhere.extend(rows_of(batch)[~fixed])
    assert len(set(everywhere)) > 10
    assert not dataset.terminals[everywhere].any()


def test_actor_goals_are_fixed_with_the_given_probability(dataset):
    batches = batches_of(dataset, [12, 13], fix_actor_goal=0.3)
    batch = batches.sample(10_000, np.random.default_rng(0))
    goals = batch['actor_goals'][:, 0].numpy()
    assert (goals == -7).mean() == pytest.approx(0.3, abs=0.02)
    others, rows = goals[goals != -7], rows_of(batch)[goals != -7]
    assert ((others > rows) & (others < 19)).all()


def test_never_fixed_goals_are_those_of_the_relabelling(dataset):
    batch = batches_of(dataset, [12], fix_actor_goal=0.0).sample(100, np.random.default_rng(0))
    assert not (batch['actor_goals'] == -7).any()


def test_all_holds_every_support_transition_once(dataset):
    batch = batches_of(dataset, [3, 9, 11, 25]).all(np.random.default_rng(0))
    assert rows_of(batch).tolist() == [3, 11, 25]
    assert (batch['actor_goals'] == -7).all()


def test_agent_without_a_critic_gets_only_what_it_needs(dataset):
    batch = batches_of(dataset, [3], 'gcbc').sample(4, np.random.default_rng(0))
    assert set(batch) == {'observations', 'actions', 'actor_goals'}


def test_same_seed_gives_the_same_batch(dataset):
    batches = batches_of(dataset, range(20), ratio=0.5, fix_actor_goal=0.5)
    first, again, other = (batches.sample(64, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not np.array_equal(first['observations'], other['observations'])


def test_drawing_changes_neither_dataset_nor_goal(dataset):
    goal = GOAL.copy()
    agent = tiny_agent(obs_dim=1, act_dim=1)
    batches = QueryBatches(agent, dataset, np.arange(5), goal)
    batches.sample(8, np.random.default_rng(0))['actor_goals'][:] = 3
    assert np.array_equal(dataset.observations[:, 0], np.arange(30))
    assert batches.sample(8, np.random.default_rng(0))['actor_goals'][0] == -7


@pytest.mark.parametrize('name', ['crl', 'gcbc', 'gciql', 'saw'])
@pytest.mark.parametrize('ratio', [1.0, 0.5])
@pytest.mark.parametrize('steps_at_once', [1, 3, 64])
def test_batches_of_many_steps_equal_one_sample_after_another(
    steps_at_once, ratio, name, dataset, monkeypatch
):
    monkeypatch.setattr(batches_module, '_GATHERED_STEPS', steps_at_once)
    batches = batches_of(dataset, range(20), name, ratio=ratio, fix_actor_goal=0.5)
    rng = np.random.default_rng(3)
    one_by_one = [batches.sample(16, rng) for _ in range(7)]
    together = list(batches.steps(7, 16, np.random.default_rng(3)))
    assert len(together) == 7
    for first, second in zip(one_by_one, together, strict=True):
        assert first.keys() == second.keys()
        assert all(torch.equal(first[key], second[key]) for key in first)
    assert list(batches.steps(0, 16, rng)) == []
