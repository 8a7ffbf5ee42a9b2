"""Drawn from recordings written with the mcap packages alone."""

from pathlib import Path

from mcap_ros2.writer import Writer
from metagcttt_core import TrajectoryDataset
from metagcttt_core.data import DatasetError
from metagcttt_tools import top_view
from metagcttt_tools.recordings.goal_views import read_goal_views
import numpy as np
from PIL import Image
import pytest

POINT = f'{"=" * 80}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n'
TEXTS = {
    'MazeState': f'uint32 episode_id\nuint32 step\ngeometry_msgs/Point position\n{POINT}',
    'GoalQuery': 'uint32 query_id\nuint32 episode_id\nbool active\n'
    f'geometry_msgs/Point position\n{POINT}',
    'AdaptationReport': 'uint32 query_id\nuint32[] segment_starts\nuint32[] segment_stops\n',
    'EpisodeEvent': 'uint8 kind\nuint32 query_id\n',
}
GRID = (
    'nav_msgs/MapMetaData info\nint8[] data\n'
    f'{"=" * 80}\nMSG: nav_msgs/MapMetaData\nfloat32 resolution\nuint32 width\nuint32 height\n'
    f'geometry_msgs/Pose origin\n{"=" * 80}\nMSG: geometry_msgs/Pose\n'
    f'geometry_msgs/Point position\n{POINT}'
)


def xy(x: float, y: float) -> dict[str, float]:
    return {'x': x, 'y': y, 'z': 0.0}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two goals in a corridor of three cells; the second is not reached."""
    path = tmp_path / 'run.mcap'
    with path.open('wb') as file:
        writer = Writer(file)
        schemas = {
            name: writer.register_msgdef(f'metagcttt_interfaces/msg/{name}', text)
            for name, text in TEXTS.items()
        }
        grid = writer.register_msgdef('nav_msgs/msg/OccupancyGrid', GRID)
        time = iter(range(10**9, 10**10, 10**6))

        def write(topic, schema, **message) -> None:
            now = next(time)
            writer.write_message(f'/robot1/{topic}', schema, message, now, now)

        info = {'resolution': 4.0, 'width': 5, 'height': 3}
        info['origin'] = {'position': xy(-6.0, -6.0)}
        walls = [100] * 5 + [100, 0, 0, 0, 100] + [100] * 5
        write('map', grid, info=info, data=walls)
        for query, reached in ((1, True), (2, False)):
            position = xy(6.0, 0.0)
            write('state', schemas['MazeState'], episode_id=query, step=0, position=xy(0.0, 0.0))
            goal = {'query_id': query, 'episode_id': query, 'position': position}
            write('goal', schemas['GoalQuery'], **goal, active=True)
            report = {'query_id': query, 'segment_starts': [0], 'segment_stops': [5]}
            write('adaptation', schemas['AdaptationReport'], **report)
            for step in range(1, 4):
                place = xy(float(step), 0.0)
                write('state', schemas['MazeState'], episode_id=query, step=step, position=place)
            write('episode', schemas['EpisodeEvent'], kind=3 if reached else 4, query_id=query)
            write('goal', schemas['GoalQuery'], **goal, active=False)
            write('state', schemas['MazeState'], episode_id=query, step=4, position=xy(9.0, 0.0))
        writer.finish()
    return path


@pytest.fixture
def dataset_file(tmp_path: Path) -> Path:
    rows = np.stack([np.arange(10.0), np.zeros(10)], axis=1)
    dataset = TrajectoryDataset.from_arrays(rows, rows, np.arange(10) == 9)
    dataset.save(tmp_path / 'walks.npz')
    return tmp_path / 'walks.npz'


def test_views_hold_the_way_while_the_goal_was_in_force(recording, dataset_file) -> None:
    maze, views = read_goal_views(recording, TrajectoryDataset.load(dataset_file), '/robot1')
    assert [view.query_id for view in views] == [1, 2]
    assert [view.reached for view in views] == [True, False]
    assert views[0].path.tolist() == [[0, 0], [1, 0], [2, 0], [3, 0]]
    assert views[0].goal == (6.0, 0.0)
    assert views[0].segments[0].tolist() == [[x, 0] for x in range(5)]
    assert maze.walls.sum() == 12
    assert maze.is_free(0.0, 0.0)
    assert not maze.is_free(-4.0, 0.0)


def test_picture_has_a_panel_for_each_goal(recording, dataset_file, tmp_path, capsys) -> None:
    files = ['--recording', str(recording), '--dataset', str(dataset_file), '--robot', '/robot1']
    top_view.main([*files, '--out', str(tmp_path / 'run.png')])
    assert '2 goals, 1 reached' in capsys.readouterr().out
    both = Image.open(tmp_path / 'run.png').size
    top_view.main([*files, '--out', str(tmp_path / 'one.png'), '--goals', '1'])
    assert both[0] > 1.5 * Image.open(tmp_path / 'one.png').size[0]


def test_animation_moves(recording, dataset_file, tmp_path) -> None:
    files = ['--recording', str(recording), '--dataset', str(dataset_file), '--robot', '/robot1']
    top_view.main([*files, '--out', str(tmp_path / 'run.gif'), '--goals', '1', '--frames', '4'])
    with Image.open(tmp_path / 'run.gif') as animation:
        assert animation.n_frames == 4


def test_another_robot_is_named_with_the_topics_there_are(recording) -> None:
    with pytest.raises(DatasetError, match=r'no map on /robot2/map; topics: /robot1/'):
        read_goal_views(recording, None, '/robot2')


def test_unknown_ending_is_refused(capsys) -> None:
    with pytest.raises(SystemExit):
        top_view.main(['--out', 'run.svg'])
    assert 'must end in .png or .gif' in capsys.readouterr().err
