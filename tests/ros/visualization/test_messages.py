import math

from metagcttt.visualization.messages import markers, odometry, path, segments_fault, thinned
import numpy as np
import pytest
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

HEADER = Header(frame_id='map')


def test_odometry_looks_and_moves_along_the_direction_of_travel() -> None:
    message = odometry(HEADER, 'base_link', (1.0, 2.0), math.pi / 2, 0.5)
    assert (message.header.frame_id, message.child_frame_id) == ('map', 'base_link')
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == (1.0, 2.0)
    assert message.pose.pose.orientation.z == pytest.approx(math.sqrt(0.5))
    assert message.pose.pose.orientation.w == pytest.approx(math.sqrt(0.5))
    assert message.twist.twist.linear.x == 0.5


def test_path_has_the_positions_in_order() -> None:
    message = path(HEADER, [(0.0, 0.0), (1.0, 0.5)])
    assert [(p.pose.position.x, p.pose.position.y) for p in message.poses] == [(0, 0), (1, 0.5)]
    assert all(p.header.frame_id == 'map' for p in message.poses)


def test_markers_show_goal_lines_and_value() -> None:
    walk = np.array([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)], np.float32)
    array = markers(
        HEADER, goal=(4.0, 5.0), radius_m=0.5, segments=[walk, walk], value=-1.234, xy=(1, 1)
    )
    lines, disc, text = array.markers
    assert [marker.action for marker in array.markers] == [Marker.ADD] * 3
    assert [point.x for point in lines.points] == [0, 1, 1, 2] * 2
    assert (disc.pose.position.x, disc.pose.position.y, disc.scale.x) == (4.0, 5.0, 1.0)
    assert text.text == 'V = -1.23'
    assert len({(marker.ns, marker.id) for marker in array.markers}) == 3


def test_markers_without_a_goal_delete_what_was_shown() -> None:
    array = markers(HEADER, goal=None, radius_m=0.5, segments=[], value=None, xy=(0, 0))
    assert [marker.action for marker in array.markers] == [Marker.DELETE] * 3


def test_thinning_keeps_the_ends_and_the_bound() -> None:
    starts, stops = np.array([0, 1000, 2000]), np.array([1000, 1003, 2001])
    found = thinned(starts, stops, max_points=100)
    assert len(found) == 2
    assert sum(len(rows) for rows in found) <= 110
    assert (found[0][0], found[0][-1], found[1][-1]) == (0, 999, 1002)
    assert thinned(starts[1:2], stops[1:2], max_points=100)[0].tolist() == [1000, 1001, 1002]
    many = np.arange(0, 10**6, 2)
    assert sum(len(rows) for rows in thinned(many, many + 2, max_points=100)) == 100


@pytest.mark.parametrize(
    ('starts', 'stops', 'fault'),
    [
        ([], [], ''),
        ([5, 0], [9, 5], ''),
        ([0], [], 'it has 1 starts and 0 stops of sub-trajectories'),
        ([0], [11], 'a sub-trajectory is empty or not within the 10 rows of the dataset'),
        ([3], [3], 'a sub-trajectory is empty or not within the 10 rows of the dataset'),
        ([0, 4], [5, 9], 'its sub-trajectories overlap'),
        ([0] * 10**6, [10] * 10**6, 'its sub-trajectories overlap'),
    ],
)
def test_ranges_of_a_report_are_checked_before_rows_are_read(starts, stops, fault: str) -> None:
    found = segments_fault(np.array(starts, np.uint32), np.array(stops, np.uint32), 10)
    assert found == fault
