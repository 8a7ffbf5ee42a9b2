"""The bridge over DDS; the test plays the robot and the policy."""

from collections.abc import Callable
from pathlib import Path
import signal
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist
from metagcttt.converters import to_time
from metagcttt.robot.node import RobotBridgeNode
from metagcttt_core.robot import ContractError
from metagcttt_interfaces.msg import ActionCommand, MazeState
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray
from std_srvs.srv import SetBool
from tests.core.robot.messages import ARM, DRIVE
from tests.ros.graph import ANY, Graph, RELIABLE


def odometry(stamp_ns: int, x: float = 0.0, frame_id: str = 'odom') -> Odometry:
    message = Odometry()
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    message.pose.pose.position.x, message.pose.pose.position.y = x, 5e6 + 1.0
    message.pose.pose.orientation.w = 1.0
    return message


class Rig:
    """A bridge to a cart, and what it sends."""

    def __init__(
        self, graph: Graph, folder: Path, text: str = DRIVE, *, use_sim_time: bool = False
    ) -> None:
        self.graph = graph
        file = folder / 'robot.yaml'
        file.write_text(text)
        self.node = graph.add(
            RobotBridgeNode,
            contract=str(file),
            diagnostics_period_s=0.05,
            use_sim_time=use_sim_time,
        )
        self.states: list[MazeState] = graph.collect(MazeState, 'state', RELIABLE)
        self.commands: list[Twist] = graph.collect(Twist, 'cmd_vel', RELIABLE)
        self.diagnostics = graph.collect(DiagnosticArray, '/diagnostics', RELIABLE)
        self._odometry = graph.node.create_publisher(Odometry, 'odom', RELIABLE)
        self._actions = graph.node.create_publisher(ActionCommand, 'action', RELIABLE)
        graph.wait(self._odometry.get_subscription_count, 'the bridge')
        graph.wait(self._actions.get_subscription_count, 'the bridge')
        self.values, self.query_id, self._answered = [1.0, 0.5], 7, 0
        self.withheld = False

    def send_odometry(self, late_s: float = 0.0, **fields) -> None:
        now_ns = self.graph.node.get_clock().now().nanoseconds
        self._odometry.publish(odometry(now_ns - round(late_s * 1e9), **fields))

    def answer(self, step: int | None = None, instance: int = 1, **names: int) -> None:
        self._actions.publish(
            ActionCommand(
                **{'episode_id': 1, 'world_id': self.states[-1].world_id, **names},
                step=self.states[-1].step if step is None else step,
                query_id=self.query_id,
                values=self.values,
                withheld=self.withheld,
                instance=instance,
            )
        )

    def drive_until(
        self, condition: Callable[[], bool], what: str, *, observe=True, act=True, **fields
    ) -> None:
        """Play robot and policy, a message of odometry every 20 ms, until something is so."""
        deadline = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < deadline, f'waited in vain for {what}: {self.health()}'
            if observe:
                self.send_odometry(**fields)
            self.graph.wait_for(0.02)
            if act and self.states and self.states[-1].step > self._answered:
                self._answered = self.states[-1].step
                self.answer()

    def drive(self) -> None:
        self.commands.clear()
        self.drive_until(lambda: any(c.angular.z for c in self.commands), 'a motion')

    def stands(self, number: int = 3) -> bool:
        """True when the last commands are zeros."""
        last = self.commands[-number:]
        return len(last) == number and not any(c.linear.x or c.angular.z for c in last)

    def health(self) -> str:
        return self.diagnostics[-1].status[0].message if self.diagnostics else ''

    def is_named(self, reason: str) -> bool:
        return any(reason in array.status[0].message for array in self.diagnostics[-40:])


@pytest.fixture
def rig(graph: Graph, tmp_path: Path) -> Rig:
    return Rig(graph, tmp_path)


def test_state_holds_the_observation_and_actions_become_commands(rig: Rig) -> None:
    rig.drive_until(lambda: len(rig.commands) > 3 and rig.commands[-1].angular.z > 0, 'commands')
    state = rig.states[-1]
    assert list(state.observation) == [0.0, 1.0, 1.0, 0.0]
    assert (state.position.x, state.position.y) == (0.0, 1.0)
    assert (state.header.frame_id, state.episode_id) == ('odom', 1)
    assert [s.step for s in rig.states] == list(range(rig.states[0].step, state.step + 1))
    assert rig.commands[-1].angular.z == pytest.approx(1.0)  # 0.5 of -2 to 2
    assert 0 < rig.commands[-1].linear.x <= 1.0


def test_late_observations_stop_the_robot_until_they_return(rig: Rig) -> None:
    rig.drive()
    num_states = len(rig.states)
    rig.drive_until(rig.stands, 'a stop', observe=False)
    assert len(rig.states) - num_states < 10  # those of the time-out
    rig.drive_until(lambda: rig.is_named('the newest usable message is'), 'health', observe=False)
    rig.drive()


def test_silent_policy_stops_the_robot_until_it_returns(rig: Rig) -> None:
    rig.drive()
    rig.drive_until(rig.stands, 'a stop', act=False)
    rig.drive_until(lambda: rig.is_named('the newest action is for'), 'the health', act=False)
    rig.drive()


@pytest.mark.parametrize(
    ('change', 'reason'),
    [({'query_id': 0}, 'no goal'), ({'withheld': True}, 'the policy keeps the robot still')],
)
def test_robot_stands_without_a_goal_and_when_the_policy_says_so(
    rig: Rig, change: dict, reason: str
) -> None:
    rig.drive()
    vars(rig).update(change)
    rig.drive_until(rig.stands, 'a stop')
    rig.drive_until(lambda: rig.is_named(reason), reason)


@pytest.mark.parametrize('values', [[1.0], [float('nan'), 0.0]])
def test_unusable_actions_are_named_and_stop_the_robot(rig: Rig, values: list[float]) -> None:
    rig.drive()
    rig.values = values
    rig.drive_until(rig.stands, 'a stop')
    rig.values = [1.0, 0.5]
    rig.drive()


def test_old_action_does_not_move_the_robot(rig: Rig) -> None:
    rig.drive()
    old = rig.states[-1].step
    rig.drive_until(rig.stands, 'a stop', act=False)
    for _ in range(5):
        rig.answer(step=old)
        rig.answer(episode_id=9)
        rig.send_odometry()
        rig.graph.wait_for(0.05)
    assert rig.stands()


def test_action_for_an_earlier_bridge_does_not_move_the_robot(rig: Rig) -> None:
    rig.drive()
    rig.drive_until(rig.stands, 'a stop', act=False)
    other = rig.states[-1].world_id ^ 1
    for _ in range(5):
        rig.answer(world_id=other)
        rig.send_odometry()
        rig.graph.wait_for(0.05)
    assert rig.stands()
    rig.drive()


def test_stop_is_latched_until_it_is_cleared(rig: Rig) -> None:
    rig.drive()
    rig.graph.publish('stop', Bool(data=True))
    rig.drive_until(rig.stands, 'a stop')
    rig.graph.publish('stop', Bool(data=False))  # does not clear it
    rig.commands.clear()
    rig.drive_until(lambda: len(rig.commands) > 10, 'more commands')
    assert rig.stands(10)
    assert rig.is_named('stopped by the topic stop')
    answer = rig.graph.call(SetBool, 'set_stop', SetBool.Request(data=False))
    assert answer.message == 'not stopped'
    rig.drive()
    answer = rig.graph.call(SetBool, 'set_stop', SetBool.Request(data=True))
    assert answer.message == 'stopped by the service set_stop'
    rig.drive_until(rig.stands, 'a stop')


def test_second_publisher_of_commands_stops_the_robot_until_it_is_gone(rig: Rig) -> None:
    rig.drive()
    other = rig.graph.node.create_publisher(Twist, 'cmd_vel', RELIABLE)
    rig.drive_until(lambda: rig.is_named('others publish on /cmd_vel'), 'the health')
    rig.drive_until(rig.stands, 'a stop')
    rig.graph.node.destroy_publisher(other)
    rig.drive()


def test_topic_of_another_type_is_named(rig: Rig) -> None:
    rig.graph.node.destroy_publisher(rig._odometry)
    other = Graph(rig.graph.context.get_domain_id())  # one participant has one type a topic
    other.node.create_publisher(Twist, 'odom', RELIABLE)
    reason = 'odom is published as geometry_msgs/msg/Twist, not nav_msgs/msg/Odometry'
    rig.drive_until(lambda: rig.is_named(reason), reason, observe=False)
    other.close()


def test_second_policy_stops_the_robot(rig: Rig) -> None:
    rig.drive()
    rig.answer(instance=2)
    rig.drive_until(rig.stands, 'a stop')
    rig.drive_until(lambda: rig.is_named('several policies'), 'the health')


@pytest.mark.parametrize(
    ('fields', 'reason'),
    [
        ({'x': float('nan')}, 'pose.pose.position.x is not finite'),
        ({'frame_id': 'map'}, "frame 'map', not 'odom'"),
        ({'late_s': 0.6}, 'before its reception: late, or another clock'),
        ({'late_s': -100.0}, 'after its reception: late, or another clock'),
        ({'x': 50.0}, 'x jumps by 50'),
    ],
)
def test_message_that_does_not_fit_is_named_and_stops_the_robot(
    rig: Rig, fields: dict, reason: str
) -> None:
    rig.drive()
    refused = rig.node._faults.counts.get('refused_messages', 0)
    rig.drive_until(
        lambda: rig.node._faults.counts.get('refused_messages', 0) > refused + 3,
        'refusals',
        **fields,
    )
    assert reason in rig.node._faults._newest[0]
    if 'x' not in fields or np.isnan(fields['x']):  # a cart that was carried away is found again
        rig.drive_until(rig.stands, 'a stop', **fields)
    rig.drive()


@pytest.mark.slow
def test_commands_stay_within_limits_and_reach_whatever_happens(rig: Rig) -> None:
    """30 % of the messages lost, others in bursts or late, and a policy that jumps about."""
    rng = np.random.default_rng(0)
    rig.drive()
    rig.commands.clear()
    arrivals: list[float] = []
    rig.graph.node.create_subscription(
        Twist, 'cmd_vel', lambda _: arrivals.append(time.monotonic()), RELIABLE
    )
    end = time.monotonic() + 6.0
    while time.monotonic() < end or len(rig.commands) <= 20:
        for _ in range(rng.choice([1, 1, 5])):
            if rng.uniform() > 0.3:
                rig.send_odometry(late_s=float(rng.choice([0.0, 0.0, 0.5])))
        rig.graph.wait_for(float(rng.choice([0.02, 0.05, 0.3])))
        if rng.uniform() > 0.3:
            rig.values = rng.uniform(-5, 5, 2).tolist()
            rig.answer()
    speeds = np.array([[c.linear.x, c.angular.z] for c in rig.commands])
    assert (np.abs(speeds[:, 1]) <= 2.0).all()
    assert ((speeds[:, 0] >= -0.5) & (speeds[:, 0] <= 1.0)).all()
    assert speeds[:, 0].any()
    # Faster changes than 1 m/s^2 over the time-out are those to zero.
    changes = np.abs(np.diff(speeds[:, 0]))[speeds[1:, 0] != 0]
    assert (changes <= 1.0 * 0.5 + 1e-9).all()


def test_joints_are_mapped_by_name_and_start_where_they_are(graph: Graph, tmp_path: Path) -> None:
    file = tmp_path / 'arm.yaml'
    file.write_text(ARM)
    bridge = graph.add(RobotBridgeNode, contract=str(file))
    states = graph.collect(MazeState, 'state', ANY)
    targets = graph.collect(Float64MultiArray, 'targets', RELIABLE)
    joints = graph.node.create_publisher(JointState, 'joint_states', RELIABLE)
    actions = graph.node.create_publisher(ActionCommand, 'action', RELIABLE)
    graph.wait(joints.get_subscription_count, 'the bridge')
    graph.wait(actions.get_subscription_count, 'the bridge')

    def move() -> bool:
        joints.publish(JointState(name=['b', 'gripper', 'a'], position=[-1.0, 0.3, 0.5]))
        if states:
            action = ActionCommand(episode_id=1, step=states[-1].step, query_id=1)
            action.values = [1.0, 1.0]
            actions.publish(action)
        return bool(targets)

    graph.wait(move, 'a target')
    assert list(states[0].observation) == [0.5, -1.0]
    np.testing.assert_allclose(targets[0].data, [-0.9, 0.6])  # b, a: a tenth of a second on

    def lose_a_joint() -> bool:
        joints.publish(JointState(name=['b', 'gripper'], position=[-1.0, 0.3]))
        return 'joint_states: no joint a' in bridge._faults._newest[0]

    graph.wait(lose_a_joint, 'the fault')


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('position.x', 'place.x', 'geometry_msgs/msg/Point has no field|has no field place'),
        ('nav_msgs/msg/Odometry', 'no_msgs/msg/Odometry', 'no_msgs/msg/Odometry is not known'),
        ('rate_hz: 10', 'rate_hz: 0', 'robot.yaml:3: rate_hz'),
    ],
)
def test_contract_that_does_not_fit_is_refused(
    graph: Graph, tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in DRIVE
    with pytest.raises(ContractError, match=message):
        Rig(graph, tmp_path, DRIVE.replace(old, new, 1))


@pytest.mark.slow
def test_process_says_farewell_with_zeros(graph: Graph, tmp_path: Path, start_process) -> None:
    file = tmp_path / 'robot.yaml'
    cases = '{fault: zeros, silent: nothing, no_goal: nothing, stop: nothing, shutdown: zeros}'
    file.write_text(DRIVE.replace('fallback: zeros', f'fallback: {cases}'))
    commands = graph.collect(Twist, 'cmd_vel', RELIABLE)
    process = start_process('robot_bridge_node', contract=str(file))
    # Nothing is observed, so there are zeros: the process has found this subscription.
    graph.wait(lambda: commands, 'zeros')
    graph.call(SetBool, 'set_stop', SetBool.Request(data=True))

    def silent() -> bool:
        commands.clear()
        graph.wait_for(0.5)
        return not commands

    graph.wait(silent, 'an end of the zeros')
    graph.wait_for(0.5)
    assert commands == []
    assert process.stop(signal_number=signal.SIGTERM) == 0
    graph.wait(lambda: commands, 'the farewell')
    assert [(c.linear.x, c.angular.z) for c in commands] == [(0.0, 0.0)]


def test_simulation_that_starts_again_is_another_world_observed_at_once(
    graph: Graph, tmp_path: Path
) -> None:
    """What was observed before never is a state, nor its goal in force, after the jump."""
    rig = Rig(graph, tmp_path, use_sim_time=True)
    clock = graph.node.create_publisher(Clock, '/clock', RELIABLE)
    graph.wait(clock.get_subscription_count, 'who follows the clock')

    def play(begin_s: float, x: float, condition: Callable[[], bool], what: str) -> None:
        now_ns, end = round(begin_s * 1e9), time.monotonic() + 30.0
        while not condition():
            assert time.monotonic() < end, f'waited in vain for {what}: {rig.health()}'
            now_ns += 20 * 10**6
            clock.publish(Clock(clock=to_time(now_ns)))
            rig._odometry.publish(odometry(now_ns, x=x))
            graph.wait_for(0.02)

    play(100.0, 1.0, lambda: len(rig.states) > 3, 'states')
    rig.answer()
    play(103.0, 1.0, lambda: any(c.angular.z for c in rig.commands), 'a motion')
    first = rig.states[-1].world_id
    rig.states.clear()
    play(10.0, 5.0, lambda: len(rig.states) > 3, 'states of the new world')
    new = [state for state in rig.states if state.world_id != first]
    assert len(new) >= 3
    assert {state.observation[0] for state in new} == {5.0}
    assert all(state.header.stamp.sec >= 100 for state in rig.states if state not in new)
    rig.commands.clear()
    rig.answer(world_id=first)
    play(12.0, 5.0, lambda: len(rig.states) > 9, 'more states')
    assert not any(command.angular.z for command in rig.commands)
    clock.publish(Clock(clock=to_time(12 * 10**9)))  # stands still from here on
    graph.wait_for(0.5)
    standing = len(rig.states)
    graph.wait_for(0.5)
    assert len(rig.states) == standing
