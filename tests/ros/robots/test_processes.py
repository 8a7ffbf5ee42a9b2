"""Robot and driver as processes that speak standard messages, over DDS."""

from collections.abc import Callable
import json
from pathlib import Path
import subprocess
import sys

from geometry_msgs.msg import TwistStamped
from metagcttt_core import TrajectoryDataset
from metagcttt_core.robot import load_contract
from metagcttt_robots.room import boxes
from metagcttt_tools import import_bags
from nav_msgs.msg import OccupancyGrid, Odometry
import numpy as np
import pytest
from std_msgs.msg import Float64MultiArray
from tests.ros.graph import EVERY, Graph, RELIABLE

ROBOTS = 'metagcttt_robots'
RADIUS_M = 0.18
CONTRACTS = Path(__file__).parents[3] / 'config' / 'robots'
OURS = ('metagcttt', 'metagcttt_core', 'metagcttt_interfaces', 'metagcttt_tools', 'sim_bridge')


@pytest.mark.parametrize('module', ['diffbot_node', 'diffbot_driver', 'arm_node', 'arm_driver'])
def test_a_robot_loads_nothing_of_the_method(module: str) -> None:
    code = (
        f'import json, sys, metagcttt_robots.{module}; '
        'print(json.dumps([name for name in sys.modules]))'
    )
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    loaded = {name.split('.')[0] for name in json.loads(run.stdout)}
    assert not loaded & {*OURS, 'torch'}


def out_of_reach(dataset: TrajectoryDataset) -> np.ndarray:
    """The rows in which no obstacle is near enough to turn the robot."""
    x, y = dataset.observations[:, :2].T
    gaps = [
        np.hypot(np.maximum(abs(x - left) - width, 0), np.maximum(abs(y - low) - height, 0))
        for left, low, width, height in boxes()
    ]
    return np.min(gaps, axis=0) > RADIUS_M + 0.05


@pytest.mark.slow
@pytest.mark.mujoco
@pytest.mark.parametrize(
    ('robot', 'contract', 'topic', 'message_type', 'values'),
    [
        ('diffbot', 'diffbot.yaml', 'cmd_vel', TwistStamped, (4, 2)),
        ('arm', 'arm4.yaml', 'arm_controller/commands', Float64MultiArray, (4, 4)),
    ],
)
def test_a_driven_robot_is_recorded_and_becomes_a_dataset(
    graph: Graph,
    start_process: Callable,
    tmp_path: Path,
    robot: str,
    contract: str,
    topic: str,
    message_type: type,
    values: tuple[int, int],
) -> None:
    bag = tmp_path / 'drive.mcap'
    recorder = start_process('recorder_node', output=str(bag), use_sim_time=True)
    graph.wait(bag.exists, 'the recorder')
    seen = graph.collect(message_type, topic, RELIABLE)
    simulator = start_process(robot, package=ROBOTS, speed_factor=0.0, patience_s=0.5)
    driver = start_process(f'{robot}_driver', package=ROBOTS)
    topics = [each.topic for each in load_contract(CONTRACTS / contract).topics]
    graph.wait(
        lambda: all(f'recording /{name} ' in recorder.log.read_text() for name in topics),
        'the recorder to find every topic',
    )
    seen.clear()  # the commands
    graph.wait(lambda: len(seen) > 300, 'the drive')
    assert driver.stop() == simulator.stop() == recorder.stop() == 0
    out = tmp_path / 'robot.npz'
    import_bags.main([f'--contract={CONTRACTS / contract}', f'--bags={bag}', f'--out={out}'])
    dataset = TrajectoryDataset.load(out)
    assert (dataset.obs_dim, dataset.act_dim) == values
    assert dataset.num_rows > 100
    if robot == 'diffbot':
        # The command of a row is in force in the period after it, which it explains; until the
        # driver is there and has planned, periods pass without commands. From one side to the
        # other the robot takes up to half a second.
        command = dataset.actions[:, 1]
        recent = np.lib.stride_tricks.sliding_window_view(command, 6)
        settled = np.pad((recent > 0.2).all(1) | (recent < -0.2).all(1), (5, 0))
        row = np.flatnonzero((~dataset.terminals & out_of_reach(dataset) & settled)[:-1])[-80:]
        yaw = np.unwrap(np.arctan2(dataset.observations[:, 3], dataset.observations[:, 2]))
        turned = np.sign(yaw[row + 1] - yaw[row])
        assert len(row) > 10
        assert np.mean(turned == np.sign(command[row])) > 0.8


@pytest.mark.mujoco
def test_late_lost_and_wrong_odometry(graph: Graph, start_process: Callable) -> None:
    seen = graph.collect(Odometry, 'odom', RELIABLE)
    grids = graph.collect(OccupancyGrid, 'map', EVERY)
    start_process(
        'diffbot',
        package=ROBOTS,
        speed_factor=5.0,
        lost_share=0.3,
        late_share=0.3,
        latency_s=0.1,
        noise_m=0.5,
    )
    graph.wait(lambda: len(seen) > 60 and grids, 'odometry')
    stamps = np.array([m.header.stamp.sec * 10 + m.header.stamp.nanosec // 10**8 for m in seen])
    assert (np.diff(stamps) < 0).any()  # late ones came after newer ones
    assert len(np.unique(stamps)) < np.ptp(stamps) + 1  # some never came
    assert 0.3 < np.std([m.pose.pose.position.x for m in seen]) < 0.8
    assert np.array(grids[0].data).reshape(80, 80)[0].all()
