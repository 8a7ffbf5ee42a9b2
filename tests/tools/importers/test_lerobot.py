"""LeRobotDataset v3 in and out; the committed one was written by LeRobot's own package."""

from collections.abc import Callable
import json
from pathlib import Path
import resource
import shutil
from typing import Any

from metagcttt_core import TrajectoryDataset
from metagcttt_core.robot.commands import Limits
from metagcttt_tools.main import main
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as pads
import pyarrow.parquet as pq
import pytest
from tests.core.builders import DATA, random_dataset
from tests.core.robot.messages import ARM, contract, DRIVE

PUSHT = DATA / 'lerobot_pusht'
DATA_FILE = 'data/chunk-000/file-000.parquet'
EPISODES_FILE = 'meta/episodes/chunk-000/file-000.parquet'


@pytest.fixture
def pusht(tmp_path: Path) -> Path:
    return Path(shutil.copytree(PUSHT, tmp_path / 'pusht'))


def convert(folder: Path, *more: str) -> TrajectoryDataset:
    out = folder.parent / 'out.npz'
    main(['import-lerobot', str(folder), '--out', str(out), '--overwrite', *more])
    return TrajectoryDataset.load(out)


def complaint(capsys: pytest.CaptureFixture, folder: Path, *more: str) -> str:
    with pytest.raises(SystemExit, match='2'):
        convert(folder, '--limits-from-data', *more)
    return capsys.readouterr().err


def change_info(folder: Path, **changes: Any) -> None:
    path = folder / 'meta' / 'info.json'
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def change_column(path: Path, name: str, change: Callable[[np.ndarray], Any]) -> None:
    table = pq.read_table(path)
    column = pa.array(change(table[name].to_numpy().copy()))
    pq.write_table(table.set_column(table.schema.get_field_index(name), name, column), path)


class TestImport:
    def test_genuine_dataset_is_read(self, pusht, capsys):
        dataset = convert(pusht, '--limits-from-data')
        table = pq.read_table(pusht / DATA_FILE)
        state = np.array(table['observation.state'].to_pylist(), np.float32)
        np.testing.assert_array_equal(dataset.observations, state)
        assert (dataset.episode_ends + 1).tolist() == [7, 12, 21]
        action = np.array(table['action'].to_pylist())
        low, high = action.min(axis=0), action.max(axis=0)
        expected = 2 * (action - low) / (high - low) - 1
        np.testing.assert_allclose(dataset.actions, expected, atol=1e-6)
        np.testing.assert_allclose(dataset.extras['time_s'][7:12], 0.1 * np.arange(5))
        text = capsys.readouterr().out
        assert 'cut where episode_index changes' in text
        assert 'motor_0: 230.278 to 370.909 became -1 to 1' in text

    def test_actions_without_limits_are_refused(self, pusht, capsys):
        with pytest.raises(SystemExit, match='2'):
            convert(pusht)
        assert 'motor_0 is 303.897 in row 0, beyond -1 to 1' in capsys.readouterr().err

    def test_column_map_picks_values_by_name_and_says_what_the_position_is(self, pusht, capsys):
        file = pusht.parent / 'columns.yaml'
        file.write_text("""
            observations:
              - {column: observation.state, values: [motor_1], origin: 100}
              - next.reward
            actions: [{column: action, values: [motor_0], low: 0, high: 512}]
            position: [motor_1]
        """)
        dataset = convert(pusht, '--columns', str(file))
        state = pq.read_table(pusht / DATA_FILE)['observation.state'].to_pylist()
        expected = np.array(state)[:, 1] - 100
        np.testing.assert_allclose(dataset.observations[:, 0], expected, rtol=1e-6)
        assert (dataset.obs_dim, dataset.act_dim) == (2, 1)
        assert 'position is motor_1: --filter.position-dims 0' in capsys.readouterr().out

    def test_several_files_are_one_dataset(self, pusht):
        """Recordings that were resumed: further files, and files of metadata."""
        table, episodes = pq.read_table(pusht / DATA_FILE), pq.read_table(pusht / EPISODES_FILE)
        later = pc.greater(table['episode_index'], 0)
        second = pads.field('episode_index') > 0
        moved = episodes.filter(second).drop_columns('data/file_index')
        moved = moved.append_column('data/file_index', pa.array([1, 1]))
        for name, content in (
            (DATA_FILE, table.filter(pc.invert(later))),
            (DATA_FILE.replace('file-000', 'file-001'), table.filter(later)),
            (EPISODES_FILE, episodes.filter(~second)),
            (EPISODES_FILE.replace('file-000', 'file-001'), moved.select(episodes.column_names)),
        ):
            pq.write_table(content, pusht / name)
        assert (
            convert(pusht, '--limits-from-data').fingerprint
            == (
                convert(Path(shutil.copytree(PUSHT, pusht.parent / 'whole')), '--limits-from-data')
            ).fingerprint
        )

    @pytest.mark.parametrize(
        ('name', 'change', 'error'),
        [
            ('dataset_from_index', lambda v: np.add(v, [0, 1, 1]), 'length 5 but rows 8 to 12'),
            ('length', lambda v: np.add(v, [0, 1, 0]), 'episode 1 has length 6 but rows 7 to 12'),
            ('data/file_index', lambda v: v + 1, 'file-001.parquet: no such file'),
            (
                'episode_index',
                lambda v: np.add(v, [0, 0, 5]),
                'episode 7 is rows 12 to 21 by meta/epis',
            ),
        ],
    )
    def test_wrong_metadata_of_episodes_are_named(self, pusht, capsys, name, change, error):
        change_column(pusht / EPISODES_FILE, name, change)
        assert error in complaint(capsys, pusht)

    def test_wrong_offsets_are_named_and_the_rows_can_be_trusted(self, pusht, capsys):
        """As conversions of merged datasets have left them: each beginning a row early."""
        expected = convert(pusht, '--limits-from-data').fingerprint
        for name in ('dataset_from_index', 'dataset_to_index'):
            change_column(pusht / EPISODES_FILE, name, lambda offset: offset - [0, 1, 1])
        error = complaint(capsys, pusht)
        assert 'episode 1 is rows 6 to 11 by meta/episodes, but by its rows 7 to 12' in error
        dataset = convert(pusht, '--limits-from-data', '--trust-rows')
        assert dataset.fingerprint == expected

    @pytest.mark.parametrize(
        ('name', 'change', 'error'),
        [
            ('index', lambda v: v + (v > 9), 'index is 11 in row 10, but there are 10 rows befo'),
            (
                'frame_index',
                lambda v: v + (v > 3),
                'frame_index of episode 0 is 5 in row 4, expec',
            ),
            ('episode_index', lambda v: v % 2, 'episode 0 is rows 0 to 7 by meta/episodes, but'),
        ],
    )
    def test_rows_out_of_order_are_named(self, pusht, capsys, name, change, error):
        change_column(pusht / DATA_FILE, name, change)
        assert error in complaint(capsys, pusht)

    def test_interrupted_recordings_are_named(self, pusht, capsys):
        for name in (EPISODES_FILE, DATA_FILE):
            path = pusht / name
            whole = path.read_bytes()
            path.write_bytes(whole[: len(whole) // 2])
            assert f'{path}: has no footer: its recording was inter' in complaint(capsys, pusht)
            path.write_bytes(whole)
        shutil.rmtree(pusht / 'meta' / 'episodes')
        assert 'was the recording finished?' in complaint(capsys, pusht)

    @pytest.mark.parametrize(
        ('changes', 'error'),
        [
            ({'codebase_version': 'v2.1'}, 'convert_dataset_v21_to_v30'),
            ({'codebase_version': None}, 'codebase_version is None, not v3'),
            ({'fps': 0}, 'fps: Input should be greater than 0, got 0'),
            ({'fps': float('inf')}, 'fps: Input should be a finite number, got inf'),
            ({'data_path': 'a\0b'}, 'data_path leads out of the folder'),
            ({'total_frames': 20}, 'counts 3 episodes and 20 frames; there are 3 and 21'),
            ({'data_path': '../{chunk_index}'}, 'data_path leads out of the folder'),
            ({'data_path': '{episode_chunk}'}, 'takes more than chunk_index and file_index'),
            ({'data_path': f'{{file_index:{10**12}d}}'}, 'of at most 99 digits'),
        ],
    )
    def test_wrong_info_is_named(self, pusht, capsys, changes, error):
        change_info(pusht, **changes)
        assert error in complaint(capsys, pusht)

    def test_rows_of_other_lengths_than_announced_are_named(self, pusht, capsys):
        features = json.loads((pusht / 'meta' / 'info.json').read_text())['features']
        for shape, error in (
            ([10**12], 'action has 2 values in a row, but shape (1000000000000,) by meta/info'),
            ([-2], 'features.action.shape.0: Input should be greater than or equal to 0, got -2'),
        ):
            change_info(
                pusht, features={**features, 'action': {**features['action'], 'shape': shape}}
            )
            assert error in complaint(capsys, pusht)

    def test_what_is_no_dataset_is_named(self, pusht, capsys):
        (pusht / 'meta' / 'info.json').write_text('{')
        assert 'info.json: cannot be read' in complaint(capsys, pusht)
        assert 'no LeRobot dataset there' in complaint(capsys, pusht.parent)
        error = complaint(capsys, pusht, '--columns', 'a.yaml', '--contract', 'b.yaml')
        assert 'give columns or contract, not both' in error

    def test_pictures_are_no_observations(self, pusht, capsys):
        features = json.loads((pusht / 'meta' / 'info.json').read_text())['features']
        file = pusht.parent / 'columns.yaml'
        file.write_text('{observations: [observation.image], actions: [action]}')
        error = complaint(capsys, pusht, '--columns', str(file))
        assert 'observation.image is a video; policies here take numbers' in error
        del features['observation.state']
        change_info(pusht, features=features)
        error = complaint(capsys, pusht)
        assert 'no feature observation.state (there are: observation.image (video)' in error


class TestExport:
    def export(self, dataset: TrajectoryDataset, folder: Path, *more: str) -> Path:
        dataset.save(folder / 'data.npz')
        out = folder / 'lerobot'
        main(['export-lerobot', str(folder / 'data.npz'), '--out', str(out), *more])
        return out

    def test_other_readers_find_the_episodes_by_the_metadata(self, tmp_path):
        """Arrow's own dataset reader alone: files, offsets and tables fit one another."""
        dataset = random_dataset((6, 4, 5), obs_dim=3)
        folder = self.export(dataset, tmp_path, '--fps', '20', '--rows-per-file', '7')
        info = json.loads((folder / 'meta' / 'info.json').read_text())
        rows = pads.dataset(folder / 'data', format='parquet').to_table()
        assert rows.num_rows == info['total_frames'] == 15
        episodes = pads.dataset(folder / 'meta' / 'episodes').to_table().to_pylist()
        assert len(episodes) == info['total_episodes'] == 3
        assert [episode['data/file_index'] for episode in episodes] == [0, 0, 1]
        for episode, start, end in zip(
            episodes, dataset.episode_starts, dataset.episode_ends, strict=True
        ):
            at = range(episode['dataset_from_index'], episode['dataset_to_index'])
            assert at == range(start, end + 1)
            here = rows.take(list(at))
            assert here['index'].to_pylist() == list(at)
            state = np.array(here['observation.state'].to_pylist(), np.float32)
            np.testing.assert_array_equal(state, dataset.observations[start : end + 1])
            assert episode['stats/observation.state/max'] == state.max(axis=0).tolist()
            assert here['next.done'].to_pylist() == [False] * (len(at) - 1) + [True]
            np.testing.assert_allclose(here['timestamp'], np.arange(len(at)) / 20, rtol=1e-6)
        assert rows.schema.field('observation.state').type == pa.list_(pa.float32(), 3)
        tasks = pq.read_table(folder / 'meta' / 'tasks.parquet')
        assert tasks.to_pylist() == [{'task_index': 0, 'task': 'reach the goal'}]
        assert json.loads(tasks.schema.metadata[b'pandas'])['index_columns'] == ['task']

    def test_layout_is_that_of_the_genuine_dataset(self, tmp_path):
        folder = self.export(random_dataset(), tmp_path, '--fps', '10')
        for name in (DATA_FILE, EPISODES_FILE):
            genuine, ours = (pq.read_schema(root / name) for root in (PUSHT, folder))
            for field in ours:
                assert field.type.equals(genuine.field(field.name).type), field
        left_out = {'next.reward', 'next.success'}
        expected = pq.read_schema(PUSHT / DATA_FILE).names
        assert set(pq.read_schema(folder / DATA_FILE).names) == set(expected) - left_out
        genuine, ours = (
            json.loads((root / 'meta' / 'info.json').read_text()) for root in (PUSHT, folder)
        )
        assert ours.keys() == genuine.keys()

    def test_what_is_written_is_read_again(self, tmp_path):
        dataset = random_dataset((4, 9), obs_dim=1, act_dim=1)
        again = convert(self.export(dataset, tmp_path, '--fps', '10'))
        assert again.fingerprint == dataset.fingerprint

    @pytest.mark.parametrize(
        ('text', 'robot', 'observed', 'commanded'),
        [
            (DRIVE, 'cart', ['x', 'y', 'yaw.cos', 'yaw.sin'], ['linear.x', 'angular.z']),
            (
                ARM.replace('low: -3, high: [3, 2], max_rate: 1', 'low: -9, high: 9, reach: 0.5'),
                'arm',
                ['a.position', 'b.position'],
                ['b.data', 'a.data'],
            ),
        ],
        ids=['cart', 'arm'],
    )
    def test_commands_are_in_units_of_the_robot(self, tmp_path, text, robot, observed, commanded):
        (tmp_path / 'cart.yaml').write_text(text)
        dataset = random_dataset((6, 4), obs_dim=len(observed))
        folder = self.export(dataset, tmp_path, '--contract', str(tmp_path / 'cart.yaml'))
        info = json.loads((folder / 'meta' / 'info.json').read_text())
        assert (info['fps'], info['robot_type']) == (10, robot)
        assert info['features']['action']['names'] == commanded
        assert info['features']['observation.state']['names'] == observed
        written = np.array(pq.read_table(folder / DATA_FILE)['action'].to_pylist())
        whole = contract(text)
        commands = Limits(whole, whole.act[0]).to_command(dataset.actions, dataset.observations)
        np.testing.assert_allclose(written, commands, rtol=1e-6)
        again = convert(folder, '--contract', str(tmp_path / 'cart.yaml'))
        np.testing.assert_array_equal(again.observations, dataset.observations)
        np.testing.assert_allclose(again.actions, dataset.actions, atol=1e-6)

    def test_full_disk_is_named_and_nothing_is_left(self, tmp_path, capsys):
        data, out = tmp_path / 'data.npz', tmp_path / 'out'
        random_dataset().save(data)
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (500, limits[1]))
        try:
            with pytest.raises(SystemExit, match='2'):
                main(['export-lerobot', str(data), '--fps', '10', '--out', str(out)])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert '.parquet: file too large' in capsys.readouterr().err
        assert {path.name for path in tmp_path.iterdir()} == {'data.npz', '.out.lock'}

    def test_what_cannot_be_written_is_named(self, tmp_path, capsys):
        with pytest.raises(SystemExit, match='2'):
            self.export(random_dataset(), tmp_path)
        assert 'how many rows a second? Give --fps' in capsys.readouterr().err
        (tmp_path / 'cart.yaml').write_text(DRIVE.replace('rate_hz: 10', 'rate_hz: 12.5'))
        more = ('--contract', str(tmp_path / 'cart.yaml'))
        with pytest.raises(SystemExit, match='2'):
            self.export(random_dataset(obs_dim=4), tmp_path, *more)
        assert 'whole frames a second, 12.5 are not' in capsys.readouterr().err
        (tmp_path / 'lerobot').mkdir()
        with pytest.raises(SystemExit, match='2'):
            self.export(random_dataset(), tmp_path, '--fps', '10')
        assert 'exists: give another --out' in capsys.readouterr().err
