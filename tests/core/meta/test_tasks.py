"""Tasks of the outer loop: drawn uniformly, redrawn when the filter finds too little."""

from metagcttt_core import FilterConfig, SupportSet, TrajectoryFilter
from metagcttt_core.meta import tasks
from metagcttt_core.meta.tasks import TaskSampler
import numpy as np
import pytest
from tests.core.builders import dataset_at, random_dataset


class FakeFilter:
    """Records every query and answers with the whole first trajectory."""

    def __init__(self, dataset, indices) -> None:
        self.dataset = dataset
        self.indices = indices
        self.segments = [(indices[0], indices[-1] + 1)]
        self.queries = []

    def query(self, state, goal, value_fn=None) -> SupportSet:
        self.queries.append((state, goal, value_fn))
        kept = len(self.segments)
        episodes, scores = np.zeros(kept, int), np.zeros(kept)
        return SupportSet(np.array(self.indices), self.segments, episodes, scores, kept, kept)


def line(length: int, offset: float = 0.0):
    return [(offset + step, 0.0) for step in range(length)]


def test_state_and_goal_are_uniform_over_all_rows():
    dataset = dataset_at([line(4), line(1, 100.0), line(5, 200.0)])
    sampler = TaskSampler(FakeFilter(dataset, [0, 1, 2]), 0.2, 128)
    rng = np.random.default_rng(0)
    for _ in range(5000):
        sampler.sample(rng)
    counts = np.zeros((2, 10))
    for query in sampler._filter.queries:
        for side in (0, 1):
            counts[side, np.flatnonzero((dataset.observations == query[side]).all(axis=1))] += 1
    assert counts.sum() == 10_000
    assert abs(counts - 500).max() < 100
    pairs = {(float(state[0]), float(goal[0])) for state, goal, _ in sampler._filter.queries}
    assert len(pairs) == 100


def test_goal_and_splits_belong_to_the_query():
    dataset = random_dataset([40])
    finder = TrajectoryFilter(dataset, FilterConfig(epsilon=5.0, top_percent=100))
    task = TaskSampler(finder, 0.25, 4).sample(np.random.default_rng(1))
    assert (dataset.observations == task.goal).all(axis=1).any()
    rows = np.concatenate([task.train.indices, task.test.indices])
    assert len(set(rows)) == len(rows)
    assert 1 <= len(task.test) <= 4
    assert len(task.train) > len(task.test)
    assert task.num_transitions >= len(rows)


def test_tasks_without_enough_data_are_redrawn_and_counted():
    """Half of all pairs lie in different trajectories, far from each other."""
    dataset = dataset_at([line(20), line(20, 1000.0)])
    sampler = TaskSampler(TrajectoryFilter(dataset, FilterConfig()), 0.2, 128)
    rng = np.random.default_rng(0)
    drawn = [sampler.sample(rng) for _ in range(200)]
    assert all(len(task.test) >= 1 for task in drawn)
    assert all(len(task.train) >= 1 for task in drawn)
    assert sum(task.redraws for task in drawn) > 100
    assert min(task.redraws for task in drawn) == 0
    for task in drawn:
        rows = np.concatenate([task.train.indices, task.test.indices])
        assert len(set(dataset.episode_of(rows))) == 1
        assert not dataset.terminals[rows].any()


def test_rows_without_a_successor_are_left_out():
    dataset = dataset_at([line(4), line(3)])
    task = TaskSampler(FakeFilter(dataset, [1, 2, 3, 6]), 0.5, 128).sample(
        np.random.default_rng(0)
    )
    rows = np.concatenate([task.train.indices, task.test.indices])
    assert sorted(rows) == [1, 2]
    assert task.num_transitions == 2


def test_support_of_one_transition_is_redrawn(monkeypatch):
    monkeypatch.setattr(tasks, '_MAX_REDRAWS', 25)
    fake = FakeFilter(dataset_at([line(4)]), [1, 3])
    message = 'none of 25 random state-goal pairs has trajectories between them: use a larger eps'
    with pytest.raises(ValueError, match=message):
        TaskSampler(fake, 0.5, 128).sample(np.random.default_rng(0))
    assert len(fake.queries) == 25


def test_critic_is_handed_to_the_filter():
    fake = FakeFilter(dataset_at([line(6)]), [0, 1, 2, 3])

    def critic(observations, goal):
        return np.zeros(len(observations))

    TaskSampler(fake, 0.5, 128).sample(np.random.default_rng(0), critic)
    assert fake.queries[0][2] is critic


def test_same_generator_gives_the_same_task():
    dataset = random_dataset([40, 40])
    sampler = TaskSampler(TrajectoryFilter(dataset, FilterConfig(epsilon=3.0)), 0.2, 128)
    first, again = (sampler.sample(np.random.default_rng(4)) for _ in range(2))
    assert np.array_equal(first.goal, again.goal)
    assert (first.train, first.test) == (again.train, again.test)


def test_longest_of_the_candidates_is_taken():
    """Each of three candidates is drawn as one alone would be, from the same generator."""
    dataset = random_dataset([60, 60])
    finder = TrajectoryFilter(dataset, FilterConfig(epsilon=3.0))
    alone = TaskSampler(finder, 0.2, 128)
    longer = TaskSampler(finder, 0.2, 128, candidates=3)
    rng, again = np.random.default_rng(5), np.random.default_rng(5)
    taken = []
    for _ in range(20):
        drawn = [alone.sample(rng) for _ in range(3)]
        task = longer.sample(again)
        best = int(np.argmax([each.mean_steps for each in drawn]))
        assert task.mean_steps == drawn[best].mean_steps
        assert (task.train, task.test) == (drawn[best].train, drawn[best].test)
        taken.append(best)
    assert set(taken) == {0, 1, 2}


def test_mean_length_of_a_task_is_that_of_its_trajectories():
    """Six transitions in two trajectories; the row without a successor does not count."""
    fake = FakeFilter(dataset_at([line(5), line(5)]), [0, 1, 2, 3, 4, 7, 8])
    fake.segments = [(0, 5), (7, 9)]
    task = TaskSampler(fake, 0.5, 128).sample(np.random.default_rng(0))
    assert (task.num_transitions, task.mean_steps) == (6, 3.0)
