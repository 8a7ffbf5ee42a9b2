import math

from metagcttt.visualization.messages import markers, odometry, path, thinned
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
    long = np.stack([np.arange(1000.0), np.zeros(1000)], axis=1)
    short = long[:3]
    found = thinned([long, short, long[:1]], max_points=100)
    assert len(found) == 2
    assert sum(len(segment) for segment in found) <= 110
    assert (found[0][0, 0], found[0][-1, 0], found[1][-1, 0]) == (0, 999, 2)
    assert len(thinned([short], max_points=100)[0]) == 3
