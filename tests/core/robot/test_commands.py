"""Commands stay within limits and in reach of one another, and turn back into their actions."""

from types import SimpleNamespace

from hypothesis import given
from hypothesis import strategies as st
from metagcttt_core.robot import MessageError
from metagcttt_core.robot.commands import (
    Commander,
    Limits,
    read_command,
    split_action,
    write_command,
)
import numpy as np
import pytest

from tests.core.robot.messages import ARM, contract, DRIVE, joints, SECOND

STEP = SECOND // 10
NOTHING_OBSERVED = np.zeros(4)
actions = st.lists(st.floats(-1, 1), min_size=2, max_size=2)


LEADING = ARM.replace('max_rate: 1', 'reach: [0.5, 0.25]')


def commander(text: str = DRIVE) -> Commander:
    whole = contract(text)
    return Commander(whole, whole.act[0])


def limits_of(text: str = DRIVE) -> Limits:
    whole = contract(text)
    return Limits(whole, whole.act[0])


@pytest.mark.parametrize('text', [DRIVE, LEADING])
@given(actions)
def test_command_turns_back_into_its_action(text, action):
    limits = limits_of(text)
    command = limits.to_command(action, NOTHING_OBSERVED)
    assert (command >= limits.low).all()
    assert (command <= limits.high).all()
    np.testing.assert_allclose(limits.to_action(command, NOTHING_OBSERVED), action, atol=1e-12)


def test_bounds_of_actions_are_the_limits():
    limits = limits_of()
    assert limits.to_command([-1, -1], NOTHING_OBSERVED).tolist() == [-0.5, -2.0]
    assert limits.to_command([7, 1], NOTHING_OBSERVED).tolist() == [1.0, 2.0]
    assert limits.to_action([0.25, 0.0], NOTHING_OBSERVED).tolist() == [0.0, 0.0]


def test_commands_with_a_reach_lead_the_measured_values_within_the_limits():
    limits = limits_of(LEADING)  # observed: a, b; commanded: b, a
    observed = np.array([[1.0, -1.0], [1.9, -2.8]])
    commands = limits.to_command([[1.0, -1.0], [-9.0, 1.0]], observed)
    np.testing.assert_allclose(commands, [[-0.5, 0.75], [-3.0, 2.0]])
    np.testing.assert_allclose(limits.to_action([-1.25, 1.125], observed[0]), [-0.5, 0.5])
    with pytest.raises(MessageError, match=r'further than \[0.5, 0.25\] .* \[-1.0, 1.0\]'):
        limits.to_action([-1.6, 1.0], observed[0])


def test_recorded_command_beyond_the_limits_is_refused_and_rounding_is_not():
    limits = limits_of()
    just_above = [float(np.nextafter(np.float32(1.0), 2)), 0]
    assert limits.to_action(just_above, NOTHING_OBSERVED)[0] == 1.0
    with pytest.raises(MessageError, match=r'commands \[1.1, 0.0\], outside the limits'):
        limits.to_action([1.1, 0.0], NOTHING_OBSERVED)


@given(st.lists(st.tuples(actions, st.integers(1, 8 * STEP)), max_size=20))
def test_commands_never_leave_limits_or_reach(sequence):
    sender, limits, now, last = commander(), limits_of(), 0, None
    for action, wait in sequence:
        now += wait
        command = sender.command(action, NOTHING_OBSERVED, now)
        assert ((command >= limits.low) & (command <= limits.high)).all()
        if last is None or wait > 0.5 * SECOND:
            last, wait = np.zeros(2), STEP  # from zero, by one period
        assert abs(command[0] - last[0]) <= 1.0 * wait / SECOND + 1e-12
        last = command


def test_first_command_of_joints_starts_where_they_are():
    sender = commander(ARM)
    command = sender.command([1.0, 1.0], np.array([0.5, -1.0]), 0)  # observed: a, b
    np.testing.assert_allclose(command, [-0.9, 0.6])  # commanded: b, a
    later = sender.command([1.0, 1.0], np.array([9.0, 9.0]), STEP)
    np.testing.assert_allclose(later, [-0.8, 0.7])
    after_a_rest = sender.command([1.0, 1.0], np.array([0.0, 0.0]), 10 * STEP)
    np.testing.assert_allclose(after_a_rest, [0.1, 0.1])


def test_fallbacks():
    sender = commander()
    assert sender.fall_back('hold', 0) is None  # there is nothing to hold
    assert sender.fall_back('nothing', 0) is None
    for step in range(5):
        moving = sender.command([1.0, 1.0], NOTHING_OBSERVED, step * STEP)
    assert sender.fall_back('hold', 5 * STEP).tolist() == moving.tolist()
    assert sender.fall_back('nothing', 6 * STEP) is None
    assert sender.fall_back('zeros', 7 * STEP).tolist() == [0.0, 0.0]  # at once
    assert sender.command([1.0, 1.0], NOTHING_OBSERVED, 8 * STEP)[0] == pytest.approx(0.1)


def test_stop_within_rates_is_gradual():
    sender = commander(
        DRIVE.replace('fallback: zeros', 'fallback: zeros\n    stops_within_rates: true')
    )
    for step in range(5):
        sender.command([1.0, 1.0], NOTHING_OBSERVED, step * STEP)
    speeds = [sender.fall_back('zeros', step * STEP)[0] for step in range(5, 11)]
    np.testing.assert_allclose(speeds, [0.4, 0.3, 0.2, 0.1, 0, 0], atol=1e-9)


def test_command_is_written_and_read_back():
    message = SimpleNamespace(linear=SimpleNamespace(x=0.0), angular=SimpleNamespace(z=0.0))
    topic = contract().act[0]
    write_command(topic, message, np.array([0.5, -1.0]))
    assert (message.linear.x, message.angular.z) == (0.5, -1.0)
    assert read_command(topic, message).tolist() == [0.5, -1.0]


def test_joint_targets_carry_their_names():
    topic = contract(ARM.replace('field: data', 'field: position')).act[0]
    message = joints()
    write_command(topic, message, np.array([2.0, 1.0]))
    assert (message.name, message.position) == (['b', 'a'], [2.0, 1.0])
    assert read_command(topic, joints(a=1.0, b=2.0)).tolist() == [2.0, 1.0]


def test_action_is_split_over_topics():
    second = """  - topic: gripper
    type: std_msgs/msg/Float64
    values: [{field: data, low: 0, high: 1}]
    fallback: hold
"""
    parts = split_action(contract(ARM + second), np.array([1.0, 2.0, 3.0]))
    assert [part.tolist() for part in parts] == [[1.0, 2.0], [3.0]]
