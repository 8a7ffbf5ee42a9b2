from dataclasses import replace

from metagcttt.converters import (
    action_message,
    goal_message,
    occupancy_grid,
    state_message,
    to_array,
    to_floats,
    to_goal,
    to_point,
    to_time,
)
from metagcttt.goal_in_force import Goal
from metagcttt_interfaces.msg import GoalQuery, MazeState
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from sim_bridge import MazeMap
from std_msgs.msg import Header

VALUES = np.array([0.1, -1 / 3, 1e-300])


def test_floats_survive_the_way_through_a_message_bit_by_bit() -> None:
    message = MazeState(observation=to_floats(VALUES))
    received = deserialize_message(serialize_message(message), MazeState)
    np.testing.assert_array_equal(to_array(received.observation), VALUES)


def test_float32_values_are_widened_exactly() -> None:
    values = VALUES.astype(np.float32)
    np.testing.assert_array_equal(to_array(to_floats(values)), values.astype(np.float64))


def test_received_array_is_a_copy() -> None:
    floats = to_floats(VALUES)
    to_array(floats)[0] = 9.0
    assert floats[0] == VALUES[0]


def test_time_splits_nanoseconds() -> None:
    stamp = to_time(3_000_000_007)
    assert (stamp.sec, stamp.nanosec) == (3, 7)


def test_point_takes_numpy_scalars() -> None:
    point = to_point(np.float32([1.5, 2.5]))
    assert (point.x, point.y, point.z) == (1.5, 2.5, 0.0)


def test_state_message_takes_numpy_flags() -> None:
    message = state_message(
        Header(frame_id='map'),
        episode_id=2,
        step=5,
        observation=VALUES,
        position=(1.0, 2.0),
        terminated=np.bool_(True),
        truncated=np.bool_(False),
        success=np.bool_(True),
    )
    assert (message.terminated, message.truncated, message.success) == (True, False, True)
    assert (message.episode_id, message.step, message.header.frame_id) == (2, 5, 'map')


def test_action_message_names_what_it_answers() -> None:
    message = action_message(
        to_time(5), episode_id=2, step=3, query_id=4, values=np.float32([0.5, -1]), adapted=True
    )
    assert (message.episode_id, message.step, message.query_id) == (2, 3, 4)
    assert (list(message.values), message.adapted) == ([0.5, -1.0], True)


def test_goal_survives_the_way_through_a_message() -> None:
    goal = Goal(query_id=3, episode_id=2, observation=VALUES, xy=(0.5, -1.0), seed=2**64 - 1)
    message = goal_message(Header(frame_id='map'), goal, active=True, lease_s=1.5)
    received = deserialize_message(serialize_message(message), GoalQuery)
    assert (received.active, received.lease_s, received.header.frame_id) == (True, 1.5, 'map')
    again = to_goal(received)
    np.testing.assert_array_equal(again.observation, VALUES)
    assert replace(again, observation=VALUES) == goal


def test_occupancy_grid_starts_at_the_lower_left_corner() -> None:
    maze = MazeMap.from_rows(('###', '#.#', '#..'), unit_m=4.0, origin_xy=(-4.0, -8.0))
    grid = occupancy_grid(maze, Header(frame_id='map'))
    assert (grid.info.width, grid.info.height, grid.info.resolution) == (3, 3, 4.0)
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-6.0, -10.0)
    assert list(grid.data) == [100, 100, 100, 100, 0, 100, 100, 0, 0]
