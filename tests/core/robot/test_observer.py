"""Observations hold what the contract asks for; what does not fit it is refused by name."""

from types import SimpleNamespace

from metagcttt_core.robot import Observer
import numpy as np
import pytest

from tests.core.robot.messages import ARM, contract, DRIVE, joints, odometry, SECOND

STEP = SECOND // 10


@pytest.fixture
def observer():
    return Observer(contract())


def test_observation_has_the_values_in_order(observer):
    turned = (0, 0, np.sin(0.3), np.cos(0.3))
    assert (
        observer.take('odom', odometry(SECOND, 1.5, 5e6 + 0.125, quaternion=turned), SECOND) == ''
    )
    values = observer.sample(SECOND)
    np.testing.assert_allclose(values, [1.5, 0.125, np.cos(0.6), np.sin(0.6)], atol=1e-15)
    assert values.dtype == np.float64
    assert (observer.segment, observer.late) == (1, '')


def test_origin_is_subtracted_before_single_precision_loses_it(observer):
    for step, y in enumerate((5e6, 5e6 + 0.01)):
        observer.take('odom', odometry(step * STEP, y=y), step * STEP)
        found = observer.sample(step * STEP).astype(np.float32)[1]
        assert found == pytest.approx(y - 5e6, abs=1e-7)
    assert np.float32(5e6 + 0.01) == np.float32(5e6)


@pytest.mark.parametrize('roll', [0.0, 0.4])
@pytest.mark.parametrize('yaw', [0.0, 2.5, -3.1])
def test_heading_is_the_yaw_of_a_rotation_about_x_after_z(observer, roll, yaw):
    cr, sr, cy, sy = (f(angle / 2) for angle in (roll, yaw) for f in (np.cos, np.sin))
    observer.take('odom', odometry(0, quaternion=(cy * sr, sy * sr, sy * cr, cy * cr)), 0)
    np.testing.assert_allclose(observer.sample(0)[2:], [np.cos(yaw), np.sin(yaw)], atol=1e-12)


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (odometry(STEP, x=float('nan')), 'pose.pose.position.x is not finite'),
        (odometry(STEP, x=1e300), 'pose.pose.position.x is beyond single precision'),
        (odometry(STEP, frame_id='map'), "frame 'map', not 'odom'"),
        (odometry(STEP, quaternion=(0, 0, 0, 0)), 'is no rotation: its length is 0'),
        (odometry(STEP, quaternion=(0, np.sqrt(0.5), 0, np.sqrt(0.5))), 'has no heading'),
        (odometry(-STEP), 'stamped 0.1 s before the message before it'),
        (odometry(-SECOND), 'stamped 1.1 s before its reception: late, or another clock'),
        (odometry(9 * SECOND), 'stamped 8.9 s after its reception: late, or another clock'),
        (odometry(STEP, x=0.21), 'x jumps by 0.21 within 0.1 s, up to 2 per second is credible'),
        (SimpleNamespace(), 'it has no header'),
        (SimpleNamespace(header=odometry(STEP).header), 'no field pose.pose.position.x'),
    ],
)
def test_message_that_does_not_fit_is_refused_and_the_one_before_stays(observer, message, reason):
    observer.take('odom', odometry(0), 0)
    refusal = observer.take('odom', message, STEP)
    assert refusal.startswith('odom: ')
    assert reason in refusal
    assert observer.sample(STEP)[0] == 0.0


def test_late_topic_ends_the_observations_and_the_next_message_begins_a_segment(observer):
    assert observer.sample(0) is None
    assert observer.late == 'odom: no usable message yet'
    observer.take('odom', odometry(0), 0)
    assert observer.sample(5 * STEP) is not None  # exactly the time-out
    assert observer.sample(5 * STEP + 1) is None
    assert observer.late == 'odom: the newest usable message is 0.50 s old'
    observer.take('odom', odometry(6 * STEP, x=0.1), 6 * STEP)
    assert observer.sample(6 * STEP) is not None
    assert observer.segment == 2


def test_age_is_that_of_the_stamp_and_not_of_the_reception(observer):
    observer.take('odom', odometry(0), 4 * STEP)
    assert observer.sample(5 * STEP) is not None
    assert observer.sample(6 * STEP) is None


@pytest.mark.parametrize('moved', [{'x': 50.0}, {'stamp_ns': -4 * STEP}])
def test_carried_robot_or_clock_set_back_is_accepted_after_the_timeout(observer, moved):
    """Refused at first; there is nothing to measure against once the time-out is over."""
    observer.take('odom', odometry(0), 0)
    observer.sample(0)
    refused = 0
    for step in range(1, 8):
        now = step * STEP
        stamp = now + moved.get('stamp_ns', 0)
        refusal = observer.take('odom', odometry(stamp, moved.get('x', 0.0)), now)
        refused += bool(refusal)
    if 'x' in moved:
        assert refused == 5
        assert observer.sample(now)[0] == 50.0
        assert observer.segment == 2
    else:
        assert refused == 3  # until the stamps have caught up
        assert observer.segment == 1


def test_break_between_two_samples_is_a_new_segment(observer):
    """The topic was silent and back again before anybody asked."""
    observer.take('odom', odometry(0), 0)
    observer.sample(0)
    observer.take('odom', odometry(9 * STEP, x=40.0), 9 * STEP)
    assert observer.sample(9 * STEP)[0] == 40.0
    assert observer.segment == 2


def test_joints_are_found_by_name_in_any_order():
    observer = Observer(contract(ARM))
    observer.take('joint_states', joints(gripper=9.0, b=2.0, a=1.0), 0)
    assert observer.sample(0).tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (joints(a=1.0, c=2.0), 'no joint b (there are: a, c)'),
        (SimpleNamespace(name=['a', 'b'], position=[1.0]), 'position has 1 values for 2 joints'),
        (SimpleNamespace(name=['a', 'b', 'a'], position=[1.0] * 3), 'joint a more than once'),
    ],
)
def test_joints_that_do_not_fit_are_refused(message, reason):
    observer = Observer(contract(ARM))
    assert reason in observer.take('joint_states', message, 0)
    assert observer.sample(0) is None


def test_clock_that_was_set_back_leaves_nothing_of_before(observer):
    """A simulation that starts again is observed at once, and by nothing that is from before."""
    observer.take('odom', odometry(90 * SECOND, x=1.0), 90 * SECOND)
    assert observer.sample(90 * SECOND)[0] == 1.0
    assert observer.sample(SECOND) is None
    assert observer.late == 'odom: the clock is 89.00 s before the newest message'
    assert observer.take('odom', odometry(SECOND, x=7.0), SECOND) == ''
    assert observer.sample(SECOND)[0] == 7.0
    assert observer.segment == 2


@pytest.mark.parametrize(('align', 'usable_s'), [('drop', 0.1), ('asof', 0.5), ('hold', 3600.0)])
def test_alignment_decides_how_old_a_message_may_be(align, usable_s):
    text = DRIVE.replace('stamp: header', f'stamp: header\n    align: {align}')
    observer = Observer(contract(text))
    observer.take('odom', odometry(0), 0)
    assert observer.sample(round(usable_s * SECOND)) is not None
    assert (observer.sample(round(usable_s * SECOND) + 1) is None) == (align != 'hold')
    # A held message may have been sent long before this reader came; others have to be fresh.
    refusal = observer.take('odom', odometry(SECOND), 9 * SECOND)
    assert ('late, or another clock' in refusal) == (align != 'hold')


@pytest.mark.parametrize(
    ('how', 'expected'),
    [
        ('scale: 0.5', [2.0]),
        ('clamp: [-1, 1]', [1.0]),
        ('transform: wrap', [4.0 - 2 * np.pi]),
        ('transform: angle', [np.cos(4.0), np.sin(4.0)]),
        ('origin: 1, scale: 2, transform: wrap', [6.0 - 2 * np.pi]),
    ],
)
def test_values_are_transformed(how, expected):
    text = DRIVE.replace('name: x, max_rate: 2.0', f'name: p, {how}').replace('[x, y]', '[y, y]')
    observer = Observer(contract(text))
    assert observer.take('odom', odometry(0, x=4.0), 0) == ''
    np.testing.assert_allclose(observer.sample(0)[: len(expected)], expected, atol=1e-12)


def test_what_is_held_outlives_a_clock_that_goes_back():
    observer = Observer(contract(DRIVE.replace('stamp: header', 'stamp: header\n    align: hold')))
    observer.take('odom', odometry(90 * SECOND, x=1.0), 90 * SECOND)
    observer.begin_again()
    assert observer.sample(SECOND)[0] == 1.0
    assert observer.take('odom', odometry(SECOND, x=7.0), SECOND) == ''
    assert observer.sample(SECOND)[0] == 7.0
