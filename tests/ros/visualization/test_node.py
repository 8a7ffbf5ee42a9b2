from pathlib import Path
import tracemalloc

from ament_index_python import get_package_share_directory
from geometry_msgs.msg import Point
from metagcttt.visualization.node import VisualizationNode
from metagcttt_core import make_agent, save_checkpoint, TrajectoryDataset
from metagcttt_interfaces.msg import AdaptationReport, GoalQuery, MazeState
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
import pytest
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from tests.ros.graph import EVERY, Graph, RELIABLE
from visualization_msgs.msg import Marker, MarkerArray
import yaml


def state(step: int, episode_id: int = 1) -> MazeState:
    message = MazeState(episode_id=episode_id, step=step, observation=[0.5 * step, 0.0])
    message.header.frame_id = 'map'
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(step * 10**8, 10**9)
    message.position = Point(x=0.5 * step, y=0.0)
    return message


def send(graph: Graph, *messages: MazeState) -> None:
    if not hasattr(graph, 'states'):
        graph.states = graph.node.create_publisher(MazeState, 'state', RELIABLE)
        graph.odometry = graph.collect(Odometry, 'odom', RELIABLE)
        graph.wait(graph.states.get_subscription_count, 'the node')
        graph.wait_for_publishers()
    for message in messages:
        known = len(graph.odometry)
        graph.states.publish(message)
        graph.wait(lambda known=known: len(graph.odometry) > known, 'the odometry')


@pytest.fixture
def critic_folder(tmp_path: Path) -> Path:
    agent = make_agent('gciql', obs_dim=2, act_dim=2, hidden=(16, 16))
    save_checkpoint(agent, tmp_path / 'gciql')
    return tmp_path / 'gciql'


def test_odometry_follows_every_state(graph: Graph, checkpoint_folder, dataset_file) -> None:
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    graph.add(VisualizationNode, **files)
    send(graph, state(0), state(1), state(2))
    last = graph.odometry[-1]
    assert last.pose.pose.position.x == 1.0
    assert last.twist.twist.linear.x == pytest.approx(5.0)
    assert (last.header.frame_id, last.child_frame_id) == ('map', 'base_link')


def test_report_on_a_million_ranges_is_ignored(
    graph: Graph, checkpoint_folder, dataset_file
) -> None:
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    node = graph.add(VisualizationNode, **files)
    tracemalloc.start()
    node._on_report(AdaptationReport(segment_starts=[0] * 10**6, segment_stops=[2640] * 10**6))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert node._segments == []
    assert peak < 2e8  # of 20 GB


def test_state_whose_frame_is_no_name_is_not_copied_into_every_pose(
    graph: Graph, checkpoint_folder: Path, dataset_file: Path
) -> None:
    logs = graph.collect(Log, '/rosout', EVERY)
    node = graph.add(
        VisualizationNode, checkpoint=str(checkpoint_folder), dataset=str(dataset_file)
    )
    send(graph, state(1))
    long = state(2)
    long.header.frame_id = 'm' * 256
    graph.states.publish(long)
    told = 'state: a message is ignored, its frame_id has 256 characters, 255 are accepted'
    graph.wait(lambda: told in [log.msg for log in logs], 'the warning')
    assert node._state.step == 1


def test_path_is_bounded_and_starts_anew_with_the_episode(
    graph: Graph, checkpoint_folder, dataset_file
) -> None:
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    graph.add(VisualizationNode, path_poses=5, rate_hz=20.0, **files)
    paths = graph.collect(PathMessage, 'path')
    send(graph, *(state(step) for step in range(8)))
    graph.wait(lambda: paths and paths[-1].poses[-1].pose.position.x == 3.5, 'the path')
    assert [pose.pose.position.x for pose in paths[-1].poses] == [1.5, 2.0, 2.5, 3.0, 3.5]
    send(graph, state(0, episode_id=2))
    graph.wait(lambda: len(paths[-1].poses) == 1, 'the new path')


def test_markers_show_what_was_retrieved_until_the_goal_is_over(
    graph: Graph, critic_folder, dataset_file
) -> None:
    files = {'checkpoint': str(critic_folder), 'dataset': str(dataset_file)}
    node = graph.add(VisualizationNode, rate_hz=20.0, **files)
    arrays = graph.collect(MarkerArray, 'markers')
    send(graph, state(0))
    goal = GoalQuery(query_id=1, episode_id=1, active=True, goal=[4.0, 0.0])
    goal.position = Point(x=4.0, y=0.0)
    graph.publish('goal', goal, EVERY)
    report = AdaptationReport(query_id=1, segment_starts=[0, 20], segment_stops=[10, 30])
    graph.publish('adaptation', report, EVERY)
    lines, disc, text = graph.wait(
        lambda: next((a.markers for a in arrays if a.markers[0].points), None), 'the markers'
    )
    rows = TrajectoryDataset.load(dataset_file).observations
    assert len(lines.points) == 2 * 2 * 9
    assert (lines.points[0].x, lines.points[0].y) == tuple(rows[0].tolist())
    assert (disc.action, disc.pose.position.x) == (Marker.ADD, 4.0)
    assert text.text.startswith('V = ')
    node.set_parameters([Parameter('marker_points', value=6)])
    report.best_step = 1  # another report
    graph.publish('adaptation', report, EVERY)
    graph.wait(lambda: 0 < len(arrays[-1].markers[0].points) < 2 * 2 * 9, 'fewer points')
    goal.active = False
    graph.publish('goal', goal, EVERY)
    graph.wait(lambda: {m.action for m in arrays[-1].markers} == {Marker.DELETE}, 'the end')


def test_rviz_file_shows_topics_that_exist() -> None:
    file = Path(get_package_share_directory('metagcttt')) / 'rviz' / 'metagcttt.rviz'
    config = yaml.safe_load(file.read_text())['Visualization Manager']
    topics = {display['Topic']['Value'] for display in config['Displays']}
    assert topics == {'/map', '/odom', '/path', '/markers'}
    tools = {tool['Topic']['Value'] for tool in config['Tools'] if 'Topic' in tool}
    assert tools == {'/goal_pose'}
    assert config['Global Options']['Fixed Frame'] == 'map'
