"""The replay buffer: what it draws, what it forgets, and that it comes back as it was."""

from metagcttt_tools.controller.replay import ReplayBuffer, Returns
import numpy as np
import torch


def test_replay_draws_whole_transitions_of_those_there_are() -> None:
    replay = ReplayBuffer(capacity=10, obs_dim=1, act_dim=1)
    for number in range(4):
        replay.add(
            observations=number, actions=number, next_observations=number + 1, rewards=number,
            masks=1,
        )  # fmt: skip
    drawn = replay.sample(200, np.random.default_rng(0))
    assert set(drawn['rewards'].tolist()) == {0, 1, 2, 3}
    assert torch.equal(drawn['observations'][:, 0] + 1, drawn['next_observations'][:, 0])
    assert torch.equal(drawn['observations'][:, 0], drawn['rewards'])


def test_full_replay_forgets_the_oldest_and_comes_back_as_it_was() -> None:
    def add(replay: ReplayBuffer, number: int) -> None:
        replay.add(observations=number, actions=0, next_observations=0, rewards=number, masks=1)

    replay, copy = (ReplayBuffer(capacity=3, obs_dim=1, act_dim=1) for _ in range(2))
    for number in range(5):
        add(replay, number)
    copy.load_tensors(replay.tensors())
    for each in (replay, copy):
        add(each, 5)
        assert (each.size, each.added) == (3, 6)
        assert sorted(each.arrays['rewards']) == [3, 4, 5]
        drawn = each.sample(100, np.random.default_rng(0))
        assert set(drawn['observations'][:, 0].tolist()) == {3, 4, 5}


def test_many_rows_at_once_are_as_many_one_by_one() -> None:
    rng = np.random.default_rng(0)
    rows = {
        'observations': rng.normal(size=(5, 2)),
        'actions': rng.normal(size=(5, 1)),
        'next_observations': rng.normal(size=(5, 2)),
        'rewards': rng.normal(size=5),
        'masks': np.ones(5),
    }
    together, single = (ReplayBuffer(capacity=7, obs_dim=2, act_dim=1) for _ in range(2))
    for _ in range(2):  # the second time around the end
        together.extend(**rows)
        for row in range(5):
            single.add(**{name: values[row] for name, values in rows.items()})
    assert together.added == single.added == 10
    for name, array in together.arrays.items():
        np.testing.assert_array_equal(array, single.arrays[name])


def collect(
    rewards: list[float], fallen_at: int | None, cut_at: int | None
) -> list[tuple[int, float, float, int]]:
    """Transitions of one robot, as (first step, return, mask, step after the last)."""
    returns, found = Returns(3, 1, 67, 21, 0.5), []
    for step, reward in enumerate(rewards):
        fallen = np.array([step == fallen_at])
        transitions = returns.add(
            observations=np.full((1, 67), step),
            actions=np.full((1, 21), -step),
            rewards=np.array([reward]),
            next_observations=np.full((1, 67), step + 1),
            fallen=fallen,
            cut=fallen | (step == cut_at),
        )
        np.testing.assert_array_equal(
            transitions['actions'][:, 0], -transitions['observations'][:, 0]
        )
        columns = (
            transitions['observations'][:, 0],
            transitions['rewards'],
            transitions['masks'],
            transitions['next_observations'][:, 0],
        )
        found += [tuple(row) for row in np.array(columns).T.tolist()]
    return sorted(found)


def test_transitions_span_three_steps_and_their_mask_two_discounts() -> None:
    # 1 + 2/2 + 4/4 = 3, then 2 + 4/2 + 8/4 = 6; the learner discounts the third step.
    assert collect([1, 2, 4, 8], None, None) == [(0, 3, 0.25, 3), (1, 6, 0.25, 4)]


def test_change_of_direction_shortens_transitions_and_still_looks_ahead() -> None:
    assert collect([1, 2, 4, 8, 16, 32], None, cut_at=3) == [
        (0, 3, 0.25, 3),
        (1, 6, 0.25, 4),
        (2, 8, 0.5, 4),
        (3, 8, 1, 4),
    ]


def test_after_a_fall_there_is_nothing() -> None:
    assert collect([1, 2], fallen_at=1, cut_at=None) == [(0, 2, 0, 2), (1, 2, 0, 2)]


def test_robots_do_not_share_their_returns() -> None:
    returns = Returns(3, 2, 67, 21, 0.5)
    ones = np.ones(2)
    step = {'observations': np.zeros((2, 67)), 'actions': np.zeros((2, 21))}
    step |= {'next_observations': np.zeros((2, 67)), 'fallen': np.zeros(2, bool)}
    transitions = returns.add(rewards=ones, cut=np.array([True, False]), **step)
    assert transitions['rewards'].tolist() == [1]
    returns.add(rewards=ones, cut=np.zeros(2, bool), **step)
    transitions = returns.add(rewards=10 * ones, cut=np.zeros(2, bool), **step)
    assert transitions['rewards'].tolist() == [1 + 0.5 + 2.5]
