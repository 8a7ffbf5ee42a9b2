"""Policies are compared with held-out trajectories; intervals are over trajectories."""

from metagcttt_core import DatasetError, FilterConfig, TrajectoryFilter
from metagcttt_core.adaptation import TTTSettings
from metagcttt_core.evaluation.offline import (
    bootstrap,
    draw_queries,
    evaluate_query,
    hold_out,
    interval,
    Query,
)
import numpy as np
import pytest
from tests.core.builders import dataset_at, maze_walks, random_dataset, tiny_agent

NEAR = FilterConfig(epsilon=4.0, top_percent=50.0)


def test_held_out_trajectories_are_not_among_the_others():
    data = random_dataset((6, 4, 5, 7, 3))
    kept, out = hold_out(data, 0.4, seed=3)
    assert (kept.num_episodes, out.num_episodes) == (3, 2)
    firsts = [part.observations[part.episode_starts] for part in (kept, out)]
    assert sorted(map(tuple, np.vstack(firsts))) == sorted(
        map(tuple, data.observations[data.episode_starts])
    )
    assert hold_out(data, 0.4, seed=3)[1].fingerprint == out.fingerprint
    with pytest.raises(DatasetError, match='leaves none on one side'):
        hold_out(data, 0.01, seed=0)


def test_goals_are_later_states_of_the_same_trajectory():
    data = random_dataset((60, 4, 30))
    queries = draw_queries(data, (3, 29, 40), per_trajectory=2, most=9, seed=0)
    rows = np.array([query.row for query in queries])
    goals = rows + [query.steps for query in queries]
    assert (data.episode_of(rows) == data.episode_of(goals)).all()
    # The trajectory of four rows takes part at three steps alone, the last one up to 29.
    assert [query.steps for query in queries] == [3, 3, 29, 29, 40, 40, 3, 3, 3, 3, 29, 29]
    assert len(draw_queries(data, (3,), per_trajectory=1, most=2, seed=0)) == 2
    with pytest.raises(DatasetError, match='longest held-out trajectory has 59 transitions'):
        draw_queries(data, (60,), per_trajectory=1, most=9, seed=0)


def test_error_and_likelihood_are_those_of_the_recorded_actions():
    data, agent = random_dataset((9,), seed=1), tiny_agent()
    found = evaluate_query(
        agent,
        TrajectoryFilter(maze_walks(), NEAR),
        data,
        Query(row=2, steps=5),
        TTTSettings(),
        [0],
    )
    goal, rows = data.observations[7], slice(2, 7)
    error = agent.act(data.observations[rows], goal) - data.actions[rows]
    assert np.abs(agent.act(data.observations[rows], goal)).max() < 1  # nothing is clipped
    assert found.errors[0] == pytest.approx(np.square(error).mean(), rel=1e-5)
    density = -0.5 * np.square(error).sum(axis=1) - np.log(2 * np.pi)
    assert found.log_likelihoods[0] == pytest.approx(density.mean(), rel=1e-5)
    assert found.distance == pytest.approx(np.linalg.norm(data.observations[2] - goal))


def test_adapting_helps_where_the_data_know_better_and_changes_nothing_without_data():
    data, ttt = maze_walks(), TTTSettings(lr=1e-2, batch_size=64)
    data.actions[:] = 0.7
    train, held_out = hold_out(data, 0.2, seed=0)
    query, agent = Query(row=10, steps=20), tiny_agent()
    found = evaluate_query(agent, TrajectoryFilter(train, NEAR), held_out, query, ttt, [0, 20])
    assert found.support > 0
    assert found.errors[20] < 0.5 * found.errors[0]
    assert found.log_likelihoods[20] > found.log_likelihoods[0]
    far = TrajectoryFilter(dataset_at([[(1e3, 1e3), (1e3, 1e3)]]), NEAR)
    found = evaluate_query(agent, far, held_out, query, ttt, [0, 20])
    assert (found.support, found.errors[20]) == (0, found.errors[0])


def test_queries_of_one_trajectory_do_not_narrow_the_interval():
    values = np.random.default_rng(0).normal(size=40)
    once = interval(bootstrap(values, np.arange(40)))
    assert once.mean == pytest.approx(values.mean())
    half_width = 1.96 * values.std() / np.sqrt(40)
    assert once.high - once.low == pytest.approx(2 * half_width, rel=0.1)
    five_times = interval(bootstrap(np.repeat(values, 5), np.repeat(np.arange(40), 5)))
    assert five_times == pytest.approx(once)
    as_if_independent = interval(bootstrap(np.repeat(values, 5), np.arange(200)))
    assert as_if_independent.high - as_if_independent.low < 0.6 * (once.high - once.low)


def test_trajectories_weigh_by_their_queries_and_columns_are_resampled_together():
    values = np.array([[1.0, 2.0], [3.0, 4.0], [8.0, 9.0]])
    draws = bootstrap(values, np.array([7, 7, 2]))
    np.testing.assert_allclose(draws[0], [4, 5])
    np.testing.assert_allclose(draws[:, 1] - draws[:, 0], 1)
