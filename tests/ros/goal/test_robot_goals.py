"""Goals of robots by pose, by named values and as whole observations."""

import math

from metagcttt.goal.goals import Resolved
from metagcttt.goal.obstacles import Obstacles
from metagcttt.goal.robot_goals import RobotGoals
from metagcttt.goal.target import miss
from metagcttt.goal.tracker import GoalRequest
from metagcttt_core import TrajectoryDataset
from metagcttt_core.robot.contract import GoalMap
from nav_msgs.msg import OccupancyGrid
import numpy as np
import pytest
from tests.core.robot.messages import ARM, contract, DRIVE

GOAL = """
goal:
  yaw: yaw
  tolerance: {distance: 0.25, yaw: 0.3}
  timeout_s: 20
  map: {clearance_m: 0.3}
"""
REACH = """
goal: {tolerance: {position: 0.05}, timeout_s: 5}
"""
CART, TWO_JOINTS = contract(DRIVE + GOAL), contract(ARM + REACH)


def data(of, low, high, rows: int = 50) -> TrajectoryDataset:
    rng = np.random.default_rng(0)
    observations = np.concatenate([[low, high], rng.uniform(low, high, (rows - 2, len(low)))])
    return TrajectoryDataset.from_arrays(
        observations, np.zeros((rows, of.act_dim)), np.arange(rows) == rows - 1
    )


def grid(cells, frame_id: str = 'odom', **origin: float) -> OccupancyGrid:
    """A map of half-metre cells; row 0 is the southern one."""
    message = OccupancyGrid()
    message.header.frame_id = frame_id
    message.info.resolution = 0.5
    message.info.height, message.info.width = np.shape(cells)
    message.info.origin.orientation.w = 1.0
    for name, value in origin.items():
        setattr(message.info.origin.position, name, value)
    message.data = np.ravel(cells).tolist()
    return message


EMPTY = grid(np.zeros((40, 40), int), x=-10.0, y=5e6 - 10.0)


@pytest.fixture
def cart() -> RobotGoals:
    goals = RobotGoals(CART, data(CART, (-5, -5, -1, -1), (5, 5, 1, 1)))
    goals.obstacles = Obstacles.of(EMPTY, CART.goal.map)
    return goals


@pytest.fixture
def arm() -> RobotGoals:
    return RobotGoals(TWO_JOINTS, data(TWO_JOINTS, (-1, -2), (1, 2)))


def pose(x: float, y: float, yaw: float = 0.0, frame_id: str = 'odom') -> GoalRequest:
    quaternion = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return GoalRequest(0, xy=(x, 5e6 + y), frame_id=frame_id, quaternion=quaternion)


def named(tolerances=(), **values: float) -> GoalRequest:
    names = tuple(name.replace('_', '.') for name in values)
    given = tuple(values.values())
    return GoalRequest(0, names=names, values=given, tolerances=tuple(tolerances))


def misses(goal: Resolved, *observation: float) -> str:
    return miss(goal.terms, np.array(observation), goal.observation)


def test_pose_fixes_position_and_heading(cart: RobotGoals) -> None:
    goal = cart.resolve(pose(1.0, -2.0, yaw=3.0))
    assert goal.xy == (1.0, -2.0)  # counted from the contract's origin
    assert goal.timeout_s == 20.0
    np.testing.assert_allclose(goal.observation, [1, -2, np.cos(3), np.sin(3)], atol=1e-9)
    assert misses(goal, 1.17, -1.83, np.cos(3.25), np.sin(3.25)) == ''  # across pi
    assert misses(goal, 1.2, -1.8, np.cos(3), np.sin(3)).startswith('distance is off by 0.283')
    assert misses(goal, 1.0, -2.0, np.cos(2.6), np.sin(2.6)).startswith('yaw is off by 0.4')
    assert 'distance is off by nan' in misses(goal, np.nan, 0, 1, 0)


def test_named_values_are_fixed_and_the_rest_is_of_the_data(arm: RobotGoals) -> None:
    goal = arm.resolve(named(b_position=1.5))
    assert goal.observation[1] == 1.5
    nearest = arm._dataset.observations[np.abs(arm._dataset.observations[:, 1] - 1.5).argmin()]
    assert goal.observation[0] == nearest[0]
    assert misses(goal, 99.0, 1.54) == ''  # the other joint is free
    assert misses(goal, 99.0, 1.56) == 'b.position is off by 0.06 (0.05 is allowed)'
    wide = arm.resolve(named([0.5], b_position=1.5))
    assert misses(wide, 0.0, 1.1) == ''


def test_whole_observation_is_reached_within_every_tolerance(arm: RobotGoals) -> None:
    goal = arm.resolve(GoalRequest(0, observation=np.array([0.5, -1.0])))
    assert misses(goal, 0.54, -1.04) == ''
    assert misses(goal, 0.4, -1.0).startswith('a.position')


def test_heading_can_be_named(cart: RobotGoals) -> None:
    goal = cart.resolve(named(yaw=1.5))
    np.testing.assert_allclose(goal.observation[2:], [np.cos(1.5), np.sin(1.5)], atol=1e-9)
    assert misses(goal, 4, 4, np.cos(1.7), np.sin(1.7)) == ''


@pytest.mark.parametrize(
    ('request_', 'error', 'reason'),
    [
        (pose(0, 0, frame_id='map'), 'WRONG_FRAME', "in frame 'map', goals are in 'odom'"),
        (pose(math.nan, 0), 'NOT_FINITE', 'is not finite'),
        (pose(5.5, 0), 'OUTSIDE_DATA', 'x 5.5 is outside the data, which span -5 to 5'),
        (named(x=6), 'OUTSIDE_DATA', 'x 6'),
        (named(elbow=1), 'UNKNOWN_VALUE', "no observed value is named 'elbow' (there are: x, y"),
        (named(x=math.inf), 'NOT_FINITE', 'x: inf'),
        (named([-1], x=1), 'NOT_FINITE', 'within -1'),
        (named([1, 2], x=1), 'WRONG_SIZE', '1 names, 1 values and 2 tolerances'),
        (GoalRequest(0, names=('x', 'x'), values=(1, 2)), 'UNKNOWN_VALUE', 'x is named twice'),
        (named(**{'z' * 10**7: 1}), 'UNKNOWN_VALUE', "no observed value is named 'zzz"),
        (GoalRequest(0, observation=np.zeros(3)), 'WRONG_SIZE', 'has 3 values'),
        (GoalRequest(0, observation=np.full(4, np.nan)), 'NOT_FINITE', 'not finite'),
        (
            GoalRequest(0, xy=(0, 5e6), frame_id='odom', quaternion=(0, 0, 0, 0)),
            'NOT_FINITE',
            'the orientation of the goal: is no rotation',
        ),
    ],
)
def test_impossible_goals_are_refused(cart: RobotGoals, request_, error, reason) -> None:
    verdict = cart.resolve(request_)
    assert verdict.error == error
    assert reason in verdict.reason


def test_robot_without_a_position_takes_no_pose(arm: RobotGoals) -> None:
    verdict = arm.resolve(pose(0, 0))
    assert verdict.error == 'UNKNOWN_VALUE'
    assert 'send a goal by named values, of a.position, b.position' in verdict.reason


def test_obstacles_need_a_map_and_keep_goals_away(cart: RobotGoals) -> None:
    cart.obstacles = None
    assert cart.resolve(pose(1, 1)).error == 'NO_MAP'
    cells = np.zeros((8, 8), int)
    cells[2, 3], cells[6, 6] = 100, -1  # x 1.5 to 2, y 1 to 1.5; an unknown one
    cart.obstacles = Obstacles.of(grid(cells, y=5e6), CART.goal.map)
    for (x, y), error in {
        (1.75, 1.25): 'IN_WALL',
        (1.21, 1.25): 'IN_WALL',  # within the clearance
        (1.19, 1.25): '',
        (3.25, 3.25): 'IN_WALL',
        (4.1, 1.0): 'OUTSIDE_MAZE',
        (-0.1, 1.0): 'OUTSIDE_MAZE',
    }.items():
        assert getattr(cart.resolve(pose(x, y)), 'error', '') == error, (x, y)
    cart.obstacles = Obstacles.of(grid(cells, 'map', y=5e6), CART.goal.map)
    assert cart.resolve(pose(1, 1)).error == 'WRONG_FRAME'


def test_map_may_be_turned() -> None:
    cells = np.zeros((2, 4), int)
    cells[0, 3] = 100
    message = grid(cells)
    message.info.origin.orientation.z = message.info.origin.orientation.w = math.sqrt(0.5)
    obstacles = Obstacles.of(message, GoalMap())
    assert obstacles.refusal(-0.25, 1.75).error == 'IN_WALL'
    assert obstacles.refusal(-0.25, 0.25) is None
    assert obstacles.refusal(0.25, 0.25).error == 'OUTSIDE_MAZE'


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'resolution': 0.0}, 'resolution of 0.0'),
        ({'width': 9}, 'the map has 4 cells for a size of'),
        ({'height': 0}, '4 cells'),
    ],
)
def test_unusable_maps_are_refused(change, message) -> None:
    broken = grid([[0, 0], [0, 0]])
    for name, value in change.items():
        setattr(broken.info, name, value)
    with pytest.raises(ValueError, match=message):
        Obstacles.of(broken, GoalMap())


def test_data_of_another_robot_are_refused_by_name() -> None:
    rows = data(CART, (-5, -5, -1, -1), (5, 5, 1, 1))
    rows.contract = contract(
        DRIVE.replace('robot: cart', 'robot: van').replace('10', '20')
    ).identity
    with pytest.raises(ValueError, match=r'was made for van .*, not for cart .*: rate_hz 20'):
        RobotGoals(CART, rows)
    with pytest.raises(ValueError, match='the contract of cart has no section goal'):
        RobotGoals(contract(), rows)
    with pytest.raises(ValueError, match='of 2 values, the contract of cart of 4'):
        RobotGoals(CART, data(TWO_JOINTS, (-1, -2), (1, 2)))
