"""A cart that speaks standard messages alone is driven by the unchanged policy, and recorded."""

from pathlib import Path

from geometry_msgs.msg import Twist
from metagcttt.policy.node import PolicyNode
from metagcttt.recorder.node import RecorderNode
from metagcttt.robot.node import RobotBridgeNode
from metagcttt_core import save_checkpoint, TrajectoryDataset
from metagcttt_core.robot import load_contract
from metagcttt_interfaces.msg import AdaptationReport, GoalQuery
from metagcttt_tools.main import main
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from tests.core.builders import tiny_agent
from tests.core.robot.messages import DRIVE
from tests.ros.graph import EVERY, Graph, RELIABLE
from tests.tools.robots.bags import drive, write


class Cart:
    """Two driven wheels; publishes odometry and obeys Twist, as any driver does."""

    def __init__(self, graph: Graph) -> None:
        self.x = self.y = self.yaw = 0.0
        self.command = Twist()
        self._node = graph.node
        self._odometry = graph.node.create_publisher(Odometry, 'odom', RELIABLE)
        graph.node.create_subscription(Twist, 'cmd_vel', self._obey, RELIABLE)
        graph.node.create_timer(0.02, self._move)

    def _obey(self, command: Twist) -> None:
        self.command = command

    def _move(self) -> None:
        v, w = self.command.linear.x, self.command.angular.z
        self.x += 0.02 * v * np.cos(self.yaw)
        self.y += 0.02 * v * np.sin(self.yaw)
        self.yaw += 0.02 * w
        message = Odometry()
        message.header.frame_id = 'odom'
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.pose.pose.position.x = float(self.x)
        message.pose.pose.position.y = float(self.y) + 5e6
        message.pose.pose.orientation.z = float(np.sin(self.yaw / 2))
        message.pose.pose.orientation.w = float(np.cos(self.yaw / 2))
        self._odometry.publish(message)

    @property
    def stands(self) -> bool:
        return not (self.command.linear.x or self.command.angular.z)


@pytest.mark.slow
def test_bag_policy_and_bag_again(graph: Graph, tmp_path: Path) -> None:
    contract, data, recording = (tmp_path / n for n in ('cart.yaml', 'cart.npz', 'run.mcap'))
    contract.write_text(DRIVE)
    bag = write(tmp_path / 'bag', drive(30))
    main(['import-bags', '--contract', str(contract), '--bags', str(bag), '--out', str(data)])
    save_checkpoint(tiny_agent(obs_dim=4, act_dim=2), tmp_path / 'policy')

    graph.add(RobotBridgeNode, contract=str(contract))
    policy = {'checkpoint': str(tmp_path / 'policy'), 'dataset': str(data)}
    graph.add(PolicyNode, adapt_steps=2, adapt_batch_size=8, epsilon=3.0, rate_hz=10.0, **policy)
    recorder = graph.add(RecorderNode, output=str(recording))
    reports = graph.collect(AdaptationReport, 'adaptation')
    cart = Cart(graph)
    goals = graph.node.create_publisher(GoalQuery, 'goal', EVERY)
    goal = GoalQuery(query_id=1, episode_id=1, active=True, goal=[1.0, 0.0, 1.0, 0.0])
    goals.publish(goal)

    graph.wait(lambda: reports and reports[-1].accepted, 'an adapted policy')
    graph.wait(lambda: not cart.stands, 'a motion')
    graph.wait_for(2.0)
    goal.active = False
    goals.publish(goal)
    graph.wait(lambda: cart.stands, 'a stop')
    graph.remove(recorder)

    again = tmp_path / 'again.npz'
    arguments = ['--contract', str(contract), '--bags', str(recording)]
    main(['import-bags', *arguments, '--out', str(again)])
    dataset = TrajectoryDataset.load(again)
    assert dataset.contract == load_contract(contract).identity
    assert dataset.num_transitions > 15
    assert np.ptp(dataset.observations[:, 2:], axis=0).max() > 0
    assert np.abs(dataset.actions).max() <= 1.0
