"""Goal relabelling: OGBench's distributions, against their exact law."""

from metagcttt_core.data import GoalConfig, GoalDistribution, GoalRelabeller, TrajectoryDataset
import numpy as np
from pydantic import ValidationError
import pytest
from scipy.stats import chi2
from tests.core.builders import DATA, random_dataset, terminals_of

CONFIGS = ['gciql_default', 'stitch_actor', 'mixed']


def numbered_dataset(lengths) -> TrajectoryDataset:
    """A dataset whose observations are the numbers of their rows."""
    rows = int(np.sum(lengths))
    numbers = np.arange(rows, dtype=np.float32)[:, None]
    return TrajectoryDataset.from_arrays(numbers, -numbers, terminals_of(lengths))


def rows_of(states: np.ndarray) -> np.ndarray:
    return states[:, 0].astype(np.int64)


@pytest.fixture(scope='module')
def golden():
    with np.load(DATA / 'relabel_hist.npz') as arrays:
        return dict(arrays)


def golden_distribution(golden, key: str) -> GoalDistribution:
    p_cur, p_traj, p_rand = golden[f'{key}.p_cur_traj_rand']
    return GoalDistribution(
        p_curgoal=p_cur, p_trajgoal=p_traj, p_randomgoal=p_rand, geometric=golden[f'{key}.geom']
    )


def golden_batch(golden, dataset_name: str, config_name: str, draws: int, seed: int):
    key = f'{dataset_name}.{config_name}'
    dataset = numbered_dataset(golden[f'{dataset_name}.lengths'])
    config = GoalConfig(
        value=golden_distribution(golden, f'{key}.value'),
        actor=golden_distribution(golden, f'{key}.actor'),
        gc_negative=bool(golden[f'{key}.gc_negative']),
    )
    relabeller = GoalRelabeller(dataset, config, float(golden[f'{key}.discount']))
    return relabeller.sample(draws, np.random.default_rng(seed))


@pytest.mark.parametrize('dataset_name', ['equal', 'ragged'])
@pytest.mark.parametrize('config_name', CONFIGS)
def test_transitions_and_goals_follow_the_reference_law(golden, dataset_name, config_name):
    draws = 200_000
    batch = golden_batch(golden, dataset_name, config_name, draws, seed=12)
    rows = rows_of(batch['observations'])
    for kind in ('value', 'actor'):
        law = golden[f'{dataset_name}.{config_name}.{kind}.joint_prob']
        counts = np.zeros(law.shape)
        np.add.at(counts, (rows, rows_of(batch[f'{kind}_goals'])), 1)
        assert counts[law == 0].sum() == 0, f'{kind}: a goal that the reference never draws'
        expected = draws * law[law > 0]
        statistic = ((counts[law > 0] - expected) ** 2 / expected).sum()
        assert statistic < chi2.ppf(0.999, len(expected) - 1), kind


@pytest.mark.parametrize('config_name', CONFIGS)
def test_rewards_and_masks_say_whether_the_value_goal_is_the_row_itself(golden, config_name):
    batch = golden_batch(golden, 'ragged', config_name, 2000, seed=3)
    reached = rows_of(batch['value_goals']) == rows_of(batch['observations'])
    assert 0 < reached.mean() < 1
    at_goal, elsewhere = (1, 0) if config_name == 'mixed' else (0, -1)
    assert np.array_equal(batch['rewards'], np.where(reached, at_goal, elsewhere))
    assert np.array_equal(batch['masks'], np.where(reached, 0, 1))


def test_batch_holds_the_transition_and_its_successor():
    dataset = random_dataset([4, 6], obs_dim=3, act_dim=2)
    rows = np.array([0, 2, 4, 8, 8])
    batch = GoalRelabeller(dataset, GoalConfig()).relabel(rows, np.random.default_rng(0))
    assert np.array_equal(batch['observations'], dataset.observations[rows])
    assert np.array_equal(batch['next_observations'], dataset.observations[rows + 1])
    assert np.array_equal(batch['actions'], dataset.actions[rows])
    assert {name: array.shape for name, array in batch.items()} == {
        'observations': (5, 3),
        'next_observations': (5, 3),
        'value_goals': (5, 3),
        'actor_goals': (5, 3),
        'actions': (5, 2),
        'rewards': (5,),
        'masks': (5,),
    }
    assert {array.dtype for array in batch.values()} == {np.dtype(np.float32)}


def test_value_and_actor_goals_are_independent():
    dataset = numbered_dataset([30])
    uniform = GoalDistribution(p_trajgoal=0, p_randomgoal=1)
    relabeller = GoalRelabeller(dataset, GoalConfig(value=uniform, actor=uniform))
    batch = relabeller.sample(20_000, np.random.default_rng(5))
    value, actor = rows_of(batch['value_goals']), rows_of(batch['actor_goals'])
    assert abs(np.corrcoef(value, actor)[0, 1]) < 0.03
    assert abs((value == actor).mean() - 1 / 29) < 0.006


def test_without_value_goals_only_what_the_actor_needs_is_drawn():
    relabeller = GoalRelabeller(random_dataset(), GoalConfig(value=None))
    batch = relabeller.sample(8, np.random.default_rng(0))
    assert set(batch) == {'observations', 'actions', 'actor_goals'}


def test_last_row_of_a_trajectory_is_never_a_goal():
    dataset = numbered_dataset([2, 3, 9])
    for goals in (
        GoalDistribution(),
        GoalDistribution(geometric=True),
        GoalDistribution(p_trajgoal=0, p_randomgoal=1),
    ):
        relabeller = GoalRelabeller(dataset, GoalConfig(value=None, actor=goals), discount=0.9)
        batch = relabeller.sample(5000, np.random.default_rng(1))
        assert not dataset.terminals[rows_of(batch['actor_goals'])].any()


def test_current_state_as_goal():
    own = GoalDistribution(p_curgoal=1, p_trajgoal=0)
    relabeller = GoalRelabeller(numbered_dataset([5, 5]), GoalConfig(value=own, actor=own))
    batch = relabeller.sample(50, np.random.default_rng(0))
    assert np.array_equal(batch['value_goals'], batch['observations'])
    assert np.array_equal(batch['actor_goals'], batch['observations'])
    assert not batch['masks'].any()


@pytest.mark.parametrize('geometric', [False, True])
def test_final_transition_has_only_itself_as_a_later_goal(geometric):
    dataset = numbered_dataset([4, 2])
    relabeller = GoalRelabeller(dataset, GoalConfig())
    rows = np.array([2, 4] * 50)
    goals = relabeller.goal_rows(
        rows, GoalDistribution(geometric=geometric), np.random.default_rng(0)
    )
    assert np.array_equal(goals, rows)


def test_same_seed_gives_the_same_batch():
    relabeller = GoalRelabeller(random_dataset([20, 20]), GoalConfig())
    first, second, other = (
        relabeller.sample(30, np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert not np.array_equal(first['actor_goals'], other['actor_goals'])


def test_probabilities_that_do_not_sum_to_one_are_refused():
    message = (
        r'p_curgoal \+ p_trajgoal \+ p_randomgoal must sum to 1, got 1.2 \(0.2 \+ 0.5 \+ 0.5\)'
    )
    with pytest.raises(ValidationError, match=message):
        GoalDistribution(p_curgoal=0.2, p_trajgoal=0.5, p_randomgoal=0.5)


@pytest.mark.parametrize('name', ['p_curgoal', 'p_trajgoal', 'p_randomgoal'])
def test_probability_outside_zero_to_one_is_refused(name):
    with pytest.raises(ValidationError, match=rf'{name}\n.*greater than or equal to 0'):
        GoalDistribution(**{name: -0.1})
