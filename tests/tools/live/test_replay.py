"""A recording is known at each of its times as a graph was then."""

from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from metagcttt.converters import occupancy_grid
from metagcttt.recorder.recording import Recording
from metagcttt_core.data import DatasetError
from metagcttt_interfaces.msg import EpisodeEvent, GoalQuery, MazeState
from metagcttt_tools.live.replay import Replay
from metagcttt_tools.live.robots import contracted, Robot
from nav_msgs.msg import OccupancyGrid
import pytest
from rclpy.serialization import serialize_message
from sim_bridge import maze_map
from std_msgs.msg import Header

pytestmark = pytest.mark.ros


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Ten seconds of a robot that goes along x, with a goal from 4 s on that it reaches at 8 s."""
    bag = Recording(tmp_path / 'run.mcap')
    types = {'map': OccupancyGrid, 'state': MazeState, 'goal': GoalQuery, 'episode': EpisodeEvent}
    topics = {f'/robot1/{name}': kind for name, kind in types.items()}
    topics['/diagnostics'] = DiagnosticArray
    for topic, kind in topics.items():
        package = kind.__module__.split('.')[0]
        bag.add_topic(topic, f'{package}/msg/{kind.__name__}')

    def add(topic: str, message: object, at_s: float) -> None:
        at_ns = 10**18 + round(at_s * 1e9)
        bag.add(topic, serialize_message(message), log_time=at_ns, publish_time=at_ns)

    add('/robot1/map', occupancy_grid(maze_map('pointmaze-medium-v0'), Header()), 0.0)
    for tenth in range(101):
        state = MazeState(observation=[tenth / 10, 0.0], episode_id=1, step=tenth)
        state.position.x = tenth / 10
        add('/robot1/state', state, tenth / 10)
        if tenth == 40:
            add('/robot1/goal', GoalQuery(query_id=1, active=True, goal=[8.0, 0.0]), 4.0)
        if tenth == 60:
            status = DiagnosticStatus(name='/robot1/goal_node', level=b'\1', message='late')
            other = DiagnosticStatus(name='/robot2/goal_node')
            add('/diagnostics', DiagnosticArray(status=[status, other]), 6.0)
        if tenth == 80:
            add('/robot1/episode', EpisodeEvent(kind=EpisodeEvent.REACHED, query_id=1), 8.0)
    bag.close()
    return bag.paths[0]


def test_time_goes_forwards_and_backwards(recording: Path) -> None:
    replay = Replay(recording, '/robot1', '', '')
    assert replay.duration_s == pytest.approx(10.0)
    assert replay.robot == Robot('pointmaze-medium-v0', (0, 1), tolerance_m=1.0)
    for at_s, has_goal, news in (
        (3.95, False, 'waiting for the graph'),
        (8.05, True, 'goal 1 reached'),
        (4.05, True, 'waiting for the graph'),
        (0.0, False, 'waiting for the graph'),
    ):
        replay.seek(at_s)
        assert replay.state.position.x == pytest.approx(int(at_s * 10) / 10)
        assert ((replay.goal is not None), replay.news) == (has_goal, news)
    replay.seek(99.0)
    assert replay.time_s == replay.duration_s


def test_folder_of_a_bag_is_read(recording: Path) -> None:
    assert Replay(recording.parent, '/robot1', '', '').duration_s == pytest.approx(10.0)


def test_health_is_that_of_the_time(recording: Path) -> None:
    replay = Replay(recording, '/robot1', '', '')
    for at_s, health in (
        (5.9, []),
        (6.1, [('goal_node', 1, 'late')]),
        (9.5, [('goal_node', 2, 'silent')]),
    ):
        replay.seek(at_s)
        assert replay.health() == health


def test_recording_of_another_robot_is_refused_with_its_topics(recording: Path) -> None:
    with pytest.raises(DatasetError, match=r'no state on /state; topics: .*/robot1/state'):
        Replay(recording, '', '', '')


def test_robot_of_a_contract_is_placed_and_turned_by_it() -> None:
    robot = contracted(Path(__file__).parents[3] / 'config' / 'robots' / 'turtlebot3.yaml')
    assert robot == Robot(position_dims=(0, 1), heading_dims=(2, 3))
