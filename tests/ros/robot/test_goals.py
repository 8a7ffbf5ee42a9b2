"""A cart and an arm reach goals of their own kind over DDS; the test is driver and policy."""

from collections.abc import Callable
from pathlib import Path

from metagcttt.commander import RobotCommander, SentGoal
from metagcttt.goal.node import GoalNode
from metagcttt.robot.node import RobotBridgeNode
from metagcttt_core import TrajectoryDataset
from metagcttt_core.robot import load_contract
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent, MazeState, NamedGoal
from nav_msgs.msg import OccupancyGrid, Odometry
import numpy as np
from sensor_msgs.msg import JointState
from tests.core.robot.messages import ARM, DRIVE
from tests.ros.graph import ANY, EVERY, Graph, RELIABLE
from tests.ros.robot.test_node import odometry

CART = f"""{DRIVE}
goal:
  tolerance: {{distance: 0.25}}
  map: {{clearance_m: 0.3}}
""".replace(', max_rate: 2.0', '')
JOINTS = f"""{ARM}
goal: {{tolerance: {{position: 0.05}}, timeout_s: 30}}
"""
RESULT = ReachGoal.Result


class Robot:
    """A bridge, a goal node and a client; the robot is where the test says."""

    def __init__(self, graph: Graph, folder: Path, text: str, limit: float = 5.0) -> None:
        self.graph = graph
        file, data = folder / 'robot.yaml', folder / 'robot.npz'
        file.write_text(text)
        contract = load_contract(file)
        ends = np.full((2, contract.obs_dim), limit) * [[-1], [1]]
        TrajectoryDataset.from_arrays(
            ends, np.zeros((2, contract.act_dim)), [False, True], contract=contract.identity
        ).save(data)
        self.is_cart = text == CART
        self.place, self.senses = [0.0, 0.0], True
        graph.add(RobotBridgeNode, contract=str(file))
        self.goals = graph.add(
            GoalNode, contract=str(file), dataset=str(data), state_timeout_s=1.0
        )
        self.events = graph.collect(EpisodeEvent, 'episode', EVERY)
        self.states = graph.collect(MazeState, 'state', ANY)
        kind, topic = (Odometry, 'odom') if self.is_cart else (JointState, 'joint_states')
        self._sensor = graph.node.create_publisher(kind, topic, RELIABLE)
        graph.node.create_timer(0.03, self.sense)
        self.client = RobotCommander(
            context=graph.context, executor=graph._executor, frame_id='odom'
        )
        graph.wait(lambda: self.states, 'states')

    def sense(self) -> None:
        if not self.senses:
            return
        if self.is_cart:
            message = odometry(self.graph.node.get_clock().now().nanoseconds, self.place[0])
            message.pose.pose.position.y = 5e6 + self.place[1]
            self._sensor.publish(message)
        else:
            self._sensor.publish(JointState(name=['b', 'a'], position=self.place[::-1]))

    def refused(self, *goal, **how) -> tuple[int, str]:
        result = self.client.send(*goal, **how).result()
        assert not result.success
        return result.error_code, result.error_msg

    def ends(self, sent: SentGoal) -> tuple[int, str]:
        result = sent.result()
        return result.error_code, result.error_msg

    def event(self, condition: Callable[[EpisodeEvent], bool]) -> EpisodeEvent:
        return self.graph.wait(lambda: next(filter(condition, self.events), None), 'the event')


def room(**obstacle: int) -> OccupancyGrid:
    """Ten by ten metres around the origin of the contract, with an obstacle at (2, 2)."""
    message = OccupancyGrid()
    message.header.frame_id = 'odom'
    message.info.resolution, message.info.width, message.info.height = 1.0, 10, 10
    message.info.origin.position.x, message.info.origin.position.y = -5.0, 5e6 - 5.0
    message.info.origin.orientation.w = 1.0
    cells = np.zeros((10, 10), int)
    cells[7, 7] = 100
    message.data = cells.ravel().tolist()
    return message


def test_cart_reaches_poses_and_named_values(graph: Graph, tmp_path: Path) -> None:
    robot = Robot(graph, tmp_path, CART)
    at = (1.0, 5e6 - 1.0)
    assert robot.refused(at) == (RESULT.NO_MAP, 'no usable map has arrived on map yet')
    graph.publish('map', OccupancyGrid(), EVERY)  # without a cell
    graph.publish('map', room(), EVERY)
    graph.wait(lambda: robot.goals._tracker._catalog.obstacles, 'the map')

    sent = robot.client.send(at)
    assert sent.accepted
    robot.place = [0.9, -0.8]
    assert robot.ends(sent) == (0, '')
    sent = robot.client.send({'x': -2.0}, tolerances={'x': 0.1})
    robot.place = [-1.95, 4.0]  # y is free
    assert robot.ends(sent) == (0, '')

    code, why = robot.ends(robot.client.send(at, max_s=0.3))
    assert code == RESULT.TIMED_OUT
    assert 'distance is off by 5.8' in why
    for goal, error, reason in (
        ((2.5, 5e6 + 2.5), RESULT.IN_WALL, 'in an obstacle'),
        ((1.8, 5e6 + 2.5), RESULT.IN_WALL, '0.20 m from an obstacle'),
        ((9.0, 5e6), RESULT.OUTSIDE_DATA, 'x 9 is outside the data'),
        ({'z': 1.0}, RESULT.UNKNOWN_VALUE, "no observed value is named 'z'"),
        ({'x': float('nan')}, RESULT.NOT_FINITE, 'x: nan'),
    ):
        code, why = robot.refused(goal)
        assert (code, reason in why) == (error, True), why
    robot.client._frame_id = 'map'
    code, why = robot.refused(at)
    assert (code, why) == (RESULT.WRONG_FRAME, "the goal is in frame 'map', goals are in 'odom'")


def test_arm_reaches_named_joints_and_whole_observations(graph: Graph, tmp_path: Path) -> None:
    robot = Robot(graph, tmp_path, JOINTS, limit=2.0)
    graph.publish('goal_values', NamedGoal(names=['a.position'], values=[1.0]))
    robot.event(lambda event: event.kind == EpisodeEvent.GOAL_ACCEPTED)
    robot.place = [1.04, -2.0]
    robot.event(lambda event: event.kind == EpisodeEvent.REACHED)
    for goal, reason in (
        (NamedGoal(), 'without names'),
        (NamedGoal(names=['a.position'], values=[1.0, 2.0]), '1 names, 2 values'),
    ):
        graph.publish('goal_values', goal)
        robot.event(lambda event, reason=reason: reason in event.reason)
    code, why = robot.refused((0.5, 0.5))
    assert code == RESULT.UNKNOWN_VALUE
    assert 'arm has no position' in why
    sent = robot.client.send({'b.position': 0.5, 'a.position': 0.0})
    robot.place = [0.0, 0.54]
    assert robot.ends(sent) == (0, '')


def test_states_of_another_contract_end_no_goal(graph: Graph, tmp_path: Path) -> None:
    robot = Robot(graph, tmp_path, JOINTS, limit=2.0)
    sent = robot.client.send({'a.position': 1.0})
    assert sent.accepted
    other = MazeState(episode_id=1, step=10**6, observation=[1.0, 0.0], contract='0' * 16)
    states = graph.node.create_publisher(MazeState, 'state', RELIABLE)
    graph.wait(lambda: states.get_subscription_count() == 2, 'both readers')
    ignored = f'the state is of contract {"0" * 16}, goals are of'

    def is_named() -> bool:
        states.publish(other)  # the goal node keeps the newest state only, this or another
        return ignored in robot.goals._monitor._faults._newest[0]

    graph.wait(is_named, 'the fault')
    assert not sent.is_done()
    robot.place = [1.0, 0.0]
    assert robot.ends(sent) == (0, '')


def test_robot_that_falls_silent_loses_its_goal_and_takes_the_next(
    graph: Graph, tmp_path: Path
) -> None:
    robot = Robot(graph, tmp_path, CART)
    graph.publish('map', room(), EVERY)
    graph.wait(lambda: robot.goals._tracker._catalog.obstacles, 'the map')
    sent = robot.client.send({'x': 1.0})
    robot.senses = False
    code, why = robot.ends(sent)
    assert (code, 'no state of episode 1' in why) == (RESULT.STATE_LOST, True)
    # Back on another clock: refused until it is the bridge's again.
    ahead = odometry(graph.node.get_clock().now().nanoseconds + 10**11, 1.0)
    robot._sensor.publish(ahead)
    robot.states.clear()
    robot.place, robot.senses = [1.0, 0.0], True
    graph.wait(lambda: robot.states, 'states again')
    assert robot.ends(robot.client.send({'x': 1.0})) == (0, '')
