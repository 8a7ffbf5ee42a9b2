"""Whatever is mixed or lost, every transition that is kept was made by one robot."""

from collections import Counter
from types import SimpleNamespace
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from metagcttt_tools.recordings.robot import Robot, usual_period_s, WORLDS
import numpy as np
import pytest

PERIOD_NS = 10**8


def stamped(ns: int) -> SimpleNamespace:
    sec, nanosec = divmod(ns, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec))


def walk(world: int, first: int, length: int, *, identified: bool) -> list[tuple[str, Any]]:
    """States and actions that tell the world and the step in all their values."""
    messages: list[tuple[str, Any]] = []
    for step in range(first, first + length):
        place = {'episode_id': 1, 'step': step, 'world_id': world if identified else 0}
        values = [float(world), float(step)]
        header = stamped(step * PERIOD_NS)
        messages.append(('state', SimpleNamespace(observation=values, header=header, **place)))
        command = SimpleNamespace(values=values, query_id=1, instance=7, **place)
        messages.append(('action', command))
    return messages


def kept(messages: list[tuple[str, Any]]) -> tuple[list[np.ndarray], Counter[str]]:
    dropped: Counter[str] = Counter()
    states = [message for kind, message in messages if kind == 'state']
    robot = Robot('/', usual_period_s(states), False, False, dropped)
    for number, (kind, message) in enumerate(messages):
        take = robot.take_state if kind == 'state' else robot.take_action
        take(message, number * PERIOD_NS // 2)
    robot.finish()
    rows = [
        np.concatenate([before, action, after])
        for observations, actions in robot.trajectories
        for before, action, after in zip(observations, actions, observations[1:], strict=False)
    ]
    return rows, dropped


def assert_of_one_robot(rows: list[np.ndarray]) -> None:
    for world, step, *others in rows:
        assert others == [world, step, world, step + 1]


lengths = st.integers(1, 12)


@settings(deadline=None)
@given(st.data(), st.lists(st.tuples(lengths, st.integers(0, 12)), min_size=2, max_size=3))
def test_robots_with_identities_in_any_mixture(data, walks) -> None:
    sent = [
        walk(number, first, length, identified=True)
        for number, (length, first) in enumerate(walks, 1)
    ]
    turns = [number for number, messages in enumerate(sent) for _ in messages]
    order = data.draw(st.permutations(turns))
    lost = data.draw(st.sets(st.integers(0, len(order) - 1)))
    queues = [iter(messages) for messages in sent]
    mixed = [next(queues[number]) for number in order]
    rows, _ = kept([message for place, message in enumerate(mixed) if place not in lost])
    assert_of_one_robot(rows)


@settings(deadline=None)
@given(st.data(), lengths)
def test_lost_messages_of_one_robot_without_identity(data, length: int) -> None:
    messages = walk(1, 0, length, identified=False)
    lost = data.draw(st.sets(st.integers(0, len(messages) - 1)))
    rows, dropped = kept([m for place, m in enumerate(messages) if place not in lost])
    assert_of_one_robot(rows)
    whole = [{2 * step, 2 * step + 1, 2 * step + 2} for step in range(length - 1)]
    assert len(rows) == sum(each.isdisjoint(lost) for each in whole)
    assert not dropped[WORLDS]


@pytest.mark.parametrize('identified', [False, True])
def test_two_whole_walks_one_after_the_other_are_two(identified: bool) -> None:
    messages = [
        message for world in (1, 2) for message in walk(world, 0, 4, identified=identified)
    ]
    rows, _ = kept(messages)
    assert_of_one_robot(rows)
    assert len(rows) == 6
