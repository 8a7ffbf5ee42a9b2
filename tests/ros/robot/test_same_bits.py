"""What trains is what serves: recorded and live messages give the same observations, in bits."""

from metagcttt_core.robot import Observer
from metagcttt_core.robot.commands import read_command
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from tests.core.robot.messages import ARM, contract
from tests.tools.robots.bags import joint_state, make, odometry, STEP, T0, TYPES

CLASSES = {'odom': Odometry, 'joint_states': JointState, 'targets': Float64MultiArray}


def live(topic: str, recorded):
    """The message as rclpy hands it to a node, from the bytes that were recorded."""
    data = bytes(TYPES.serialize_cdr(recorded, recorded.__msgtype__))
    return deserialize_message(data, CLASSES[topic])


def record(recorded):
    """The message as the bag reader hands it over."""
    name = recorded.__msgtype__
    return TYPES.deserialize_cdr(TYPES.serialize_cdr(recorded, name), name)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_odometry(rng: np.random.Generator) -> None:
    recorded, served = Observer(contract()), Observer(contract())
    seen = 0
    x = np.cumsum(rng.uniform(-0.15, 0.15, 200))
    for step, place in enumerate(x):
        now = T0 + step * STEP
        message = odometry(now - int(rng.integers(0, STEP)), place, 5e6 + place, rng.normal())
        refusals = [
            recorded.take('odom', record(message), now),
            served.take('odom', live('odom', message), now),
        ]
        assert refusals[0] == refusals[1]
        one, other = recorded.sample(now), served.sample(now)
        assert one is not None and other is not None
        assert one.tobytes() == other.tobytes()
        seen += 1
    assert (seen, recorded.segment) == (200, served.segment)


def test_joints_and_their_commands(rng: np.random.Generator) -> None:
    arm = contract(ARM)
    recorded, served = Observer(arm), Observer(arm)
    layout = make('std_msgs/msg/MultiArrayLayout', dim=[], data_offset=0)
    for step in range(50):
        now = T0 + step * STEP
        names = list(rng.permutation(['a', 'b', 'c']))
        message = joint_state(now, names, rng.normal(size=3).tolist())
        assert recorded.take('joint_states', record(message), now) == ''
        assert served.take('joint_states', live('joint_states', message), now) == ''
        assert recorded.sample(now).tobytes() == served.sample(now).tobytes()
        target = make('std_msgs/msg/Float64MultiArray', layout=layout, data=rng.normal(size=2))
        commands = [read_command(arm.act[0], each(target)) for each in (record, of_targets)]
        assert commands[0].tobytes() == commands[1].tobytes()


def of_targets(message):
    return live('targets', message)
