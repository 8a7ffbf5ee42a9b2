"""The robots obey mechanics: wheels tell where a robot is, obstacles stop, limits hold."""

from metagcttt_robots.arm import Arm, HIGH
from metagcttt_robots.diffbot import ACCELERATIONS, Diffbot, LIMITS, TRACK_M, WHEEL_RADIUS_M
from metagcttt_robots.planner import inflate, shortest_path
from metagcttt_robots.room import boxes, obstacles, UNIT_M
import numpy as np
import pytest

pytestmark = pytest.mark.mujoco
IN_THE_OPEN = (-2.75, -1.75, 0.0)


@pytest.mark.parametrize('command', [(0.8, 0.0), (0.0, 2.0), (0.5, 1.0), (-0.4, 0.5)])
def test_wheel_odometry_equals_the_pose(command: tuple[float, float]) -> None:
    robot = Diffbot()
    robot.place(*IN_THE_OPEN)
    before, _ = robot.wheels
    x, y, yaw = IN_THE_OPEN
    for _ in range(60):
        robot.command(*command)
        robot.advance(0.02)
        after, _ = robot.wheels
        left, right = (after - before) * WHEEL_RADIUS_M
        before = after
        turn = (right - left) / TRACK_M
        x += (left + right) / 2 * np.cos(yaw + turn / 2)
        y += (left + right) / 2 * np.sin(yaw + turn / 2)
        yaw += turn
    motion = robot.motion
    assert np.hypot(x - motion.x, y - motion.y) < 0.02
    assert abs(np.angle(np.exp(1j * (yaw - motion.yaw)))) < 0.05
    assert abs(yaw) + np.hypot(x - IN_THE_OPEN[0], y - IN_THE_OPEN[1]) > 0.3  # it did move


def test_commands_are_limited_and_time_out() -> None:
    robot = Diffbot()
    robot.place(*IN_THE_OPEN)
    robot.command(9.0, 0.0)
    robot.advance(0.1)
    assert robot.motion.v <= ACCELERATIONS[0] * 0.1 + 0.05
    robot.advance(0.38)
    assert robot.motion.v == pytest.approx(LIMITS[0], rel=0.05)
    robot.advance(1.5)  # without another command
    assert robot.motion.v == pytest.approx(0.0, abs=0.02)


def test_obstacles_stop_the_robot() -> None:
    robot = Diffbot()
    robot.place(-2.75, -1.75, np.pi)
    for _ in range(30):
        robot.command(0.8, 0.0)
        robot.advance(0.1)
    assert -3.5 + 0.17 < robot.motion.x < -3.5 + 0.2  # the wall and its radius


def test_boxes_are_the_obstacles_of_the_map() -> None:
    assert sum(4 * a * b for _, _, a, b in boxes()) == obstacles().sum() * UNIT_M**2


def test_paths_keep_away_from_obstacles_and_are_shortest() -> None:
    occupied = np.zeros((7, 9), bool)
    occupied[:4, 4] = True
    inflated = inflate(occupied, 1)
    path = shortest_path(inflated, (2, 2), (2, 6))
    assert (path[0], path[-1]) == ((2, 2), (2, 6))
    assert not any(inflated[cell] for cell in path)
    steps = np.hypot(*np.diff(path, axis=0).T)
    assert steps.sum() == pytest.approx(6 + 2 * np.sqrt(2))
    occupied[4:, 4] = True
    assert shortest_path(occupied, (2, 2), (2, 6)) == []


def test_the_post_is_in_the_arm_s_way_unless_it_is_raised() -> None:
    def moved(arm: Arm, *target: float) -> np.ndarray:
        arm.command(np.array(target))
        arm.advance(3.0)
        return arm.joints[0]

    arm = Arm()
    np.testing.assert_allclose(moved(arm, -1, 0.1, -0.2, 0.5), [-1, 0.1, -0.2, 0.5], atol=0.02)
    assert moved(arm, 1, 0.1, -0.2, 0.5)[0] < 0
    moved(arm, -1, 1.1, -0.3, 0.5)
    moved(arm, 1, 1.1, -0.3, 0.5)
    np.testing.assert_allclose(moved(arm, 1, 0.1, -0.2, 0.5), [1, 0.1, -0.2, 0.5], atol=0.02)
    assert (moved(arm, 9, 9, 9, 9) <= HIGH + 0.02).all()
