"""Bags as people have them become datasets by a contract, and what does not fit it is named."""

from contextlib import closing
from pathlib import Path
import sqlite3
from types import SimpleNamespace

import mcap.reader
import mcap.writer
from metagcttt_core import TrajectoryDataset
from metagcttt_tools.common import unpacking
from metagcttt_tools.main import main
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from tests.core.robot.messages import ARM, DRIVE
from tests.tools.robots.bags import drive, joint_state, make, odometry, STEP, T0, twist, write
import yaml


@pytest.fixture
def contract_file(tmp_path: Path) -> Path:
    file = tmp_path / 'cart.yaml'
    file.write_text(DRIVE)
    return file


def convert(contract_file: Path, *bags: Path, more: tuple[str, ...] = ()) -> TrajectoryDataset:
    out = contract_file.parent / 'out.npz'
    arguments = ['--contract', str(contract_file), '--bags', *map(str, bags), *more]
    main(['import-bags', *arguments, '--out', str(out), '--overwrite'])
    return TrajectoryDataset.load(out)


def complaint(contract_file: Path, bag: Path, capsys: pytest.CaptureFixture) -> str:
    with pytest.raises(SystemExit, match='2'):
        convert(contract_file, bag)
    return capsys.readouterr().err


def files_of(bag: Path) -> list[Path]:
    return [path for path in bag.iterdir() if path.suffix in ('.mcap', '.db3')]


@pytest.mark.parametrize(
    ('storage', 'compression'),
    [
        (StoragePlugin.MCAP, CompressionMode.NONE),
        (StoragePlugin.MCAP, CompressionMode.FILE),
        (StoragePlugin.MCAP, CompressionMode.STORAGE),  # zstd chunks inside the file
        (StoragePlugin.SQLITE3, CompressionMode.NONE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    ],
)
def test_drive_becomes_a_trajectory(contract_file, tmp_path, storage, compression):
    bag = write(tmp_path / 'bag', drive(), storage, compression)
    dataset = convert(contract_file, bag)
    assert (dataset.num_episodes, dataset.num_transitions) == (1, 19)
    assert [each['name'] for each in dataset.made_from['sources']] == ['cart.yaml', 'bag']
    assert dataset.made_from['sources'][1]['bytes'] == sum(f.stat().st_size for f in bag.iterdir())
    steps = np.arange(20)
    np.testing.assert_allclose(dataset.observations[:, 0], 0.05 * steps, atol=1e-6)
    assert (dataset.observations[:, 1] == 0).all()  # the origin is taken off
    np.testing.assert_allclose(dataset.observations[:, 2], np.cos(0.1 * steps), atol=1e-6)
    # -0.5 to 1 and -2 to 2 became -1 to 1; each row has the command that followed it.
    np.testing.assert_allclose(dataset.actions[:-1, 0], 1 / 3, atol=1e-6)
    np.testing.assert_allclose(dataset.actions[:-1, 1], (0.1 * steps[:-1] - 1) / 2, atol=1e-6)


def test_long_trajectory_is_cut_without_a_loss(contract_file, tmp_path):
    bag = write(tmp_path / 'bag', drive())
    whole = convert(contract_file, bag)
    cut = convert(contract_file, bag, more=('--longest-s', '0.8'))
    assert np.diff(cut.episode_ends, prepend=-1).tolist() == [9, 9, 4]  # 8, 8 and 3 transitions
    starts = cut.episode_starts[1:]
    np.testing.assert_array_equal(cut.observations[starts], cut.observations[starts - 1])
    rows = np.setdiff1d(np.arange(cut.num_rows), cut.episode_ends)
    np.testing.assert_array_equal(cut.observations[rows], whole.observations[:-1])
    np.testing.assert_array_equal(cut.actions[rows], whole.actions[:-1])


@pytest.mark.parametrize('storage', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_single_file_is_a_bag(contract_file, tmp_path, storage):
    bag = write(tmp_path / 'bag', drive(), storage)
    assert convert(contract_file, *files_of(bag)).num_transitions == 19


def test_lz4_chunks_are_read(contract_file, tmp_path):
    """As `ros2 bag record --storage-preset-profile fastwrite` and MCAP's own tools keep them."""
    [whole] = files_of(write(tmp_path / 'bag', drive()))
    packed = tmp_path / 'lz4.mcap'
    with whole.open('rb') as source, packed.open('wb') as target:
        reader = mcap.reader.make_reader(source)
        writer = mcap.writer.Writer(target, compression=mcap.writer.CompressionType.LZ4)
        writer.start('ros2')
        schemas, channels = {}, {}
        for schema, channel, message in reader.iter_messages():
            if schema.id not in schemas:
                parts = schema.name, schema.encoding, schema.data
                schemas[schema.id] = writer.register_schema(*parts)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            number = channels[channel.id]
            writer.add_message(number, message.log_time, message.data, message.publish_time)
        writer.finish()
    assert b'lz4' in packed.read_bytes()
    assert convert(contract_file, packed).fingerprint == convert(contract_file, whole).fingerprint


def test_bag_of_humble_is_read_without_definitions_of_types(contract_file, tmp_path):
    """Its database has no table of definitions, its metadata are of version 5."""
    bag = write(tmp_path / 'bag', drive(), StoragePlugin.SQLITE3)
    expected = convert(contract_file, bag).fingerprint
    [file] = files_of(bag)
    with closing(sqlite3.connect(file)) as database, database:
        database.execute('DROP TABLE message_definitions')
        database.execute('DROP TABLE schema')
    metadata = yaml.safe_load((bag / 'metadata.yaml').read_text())
    information = metadata['rosbag2_bagfile_information']
    information['version'] = 5
    del information['ros_distro'], information['custom_data']
    for each in information['topics_with_message_count']:
        each['topic_metadata']['offered_qos_profiles'] = ''
        del each['topic_metadata']['type_description_hash']
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(metadata))
    assert convert(contract_file, bag).fingerprint == expected
    assert convert(contract_file, file).fingerprint == expected


def test_split_bag_is_one_recording(contract_file, tmp_path):
    """No trajectory ends where a file does."""
    messages = drive(30)
    expected = convert(contract_file, write(tmp_path / 'whole', messages))
    parts = [write(tmp_path / f'part{n}', messages[30 * n :][:30]) for n in range(2)]
    folder = tmp_path / 'split'
    folder.mkdir()
    metadata = yaml.safe_load((parts[0] / 'metadata.yaml').read_text())
    information = metadata['rosbag2_bagfile_information']
    names, entries = [], []
    for number, part in enumerate(parts):
        [file] = files_of(part)
        names.append(f'split_{number}.mcap')
        file.rename(folder / names[-1])
        other = yaml.safe_load((part / 'metadata.yaml').read_text())
        [entry] = other['rosbag2_bagfile_information']['files']
        entries.append({**entry, 'path': names[-1]})
    last = entries[-1]
    end_ns = last['starting_time']['nanoseconds_since_epoch'] + last['duration']['nanoseconds']
    start_ns = information['starting_time']['nanoseconds_since_epoch']
    information.update(relative_file_paths=names, files=entries, message_count=60)
    information['duration'] = {'nanoseconds': end_ns - start_ns}
    for each in information['topics_with_message_count']:
        each['message_count'] = 30
    (folder / 'metadata.yaml').write_text(yaml.safe_dump(metadata))
    dataset = convert(contract_file, folder)
    assert dataset.num_episodes == 1
    assert dataset.fingerprint == expected.fingerprint


def test_bags_follow_one_another_and_robots_have_namespaces(contract_file, tmp_path):
    named = [(f'/cart1{topic}', *rest) for topic, *rest in drive(6)]
    bags = [write(tmp_path / f'bag{n}', named) for n in range(2)]
    dataset = convert(contract_file, *bags, more=('--namespace', 'cart1'))
    assert (dataset.num_episodes, dataset.num_transitions) == (2, 10)


def test_gap_cuts_the_trajectory(contract_file, tmp_path):
    gap = range(T0 + 8 * STEP - 1, T0 + 16 * STEP)
    kept = [m for m in drive(30) if m[0] != '/odom' or m[2] not in gap]
    dataset = convert(contract_file, write(tmp_path / 'bag', kept))
    assert dataset.num_episodes == 2
    assert dataset.observations[dataset.episode_starts[1], 0] == pytest.approx(0.05 * 16)


def test_rows_without_a_command_are_left_out(contract_file, tmp_path):
    """The first command comes late, and the cart is no longer commanded at the end."""
    commanded = range(T0 + 5 * STEP, T0 + 10 * STEP)
    kept = [m for m in drive(30) if m[0] == '/odom' or m[2] in commanded]
    dataset = convert(contract_file, write(tmp_path / 'bag', kept))
    assert dataset.num_episodes == 1
    x = dataset.observations[:, 0]
    assert x[0] == pytest.approx(0.05 * 5)
    assert x[-1] == pytest.approx(0.05 * 15)  # the last command held for its time-out


def test_command_at_the_time_of_an_observation_is_not_its_answer(contract_file, tmp_path):
    """It was under way before; the one within the period that follows is."""
    messages = [(t, m, n - 2 * 10**7 if t == '/cmd_vel' else n) for t, m, n in drive(10)]
    actions = convert(contract_file, write(tmp_path / 'bag', messages)).actions[:-1]
    np.testing.assert_allclose(actions[:, 1], (0.1 * np.arange(1, 10) - 1) / 2, atol=1e-6)


def reaching(tmp_path: Path) -> Path:
    """A bag of an arm whose joints, told in changing order, are commanded elsewhere."""
    layout = make('std_msgs/msg/MultiArrayLayout', dim=[], data_offset=0)
    messages = []
    for step in range(5):
        now = T0 + step * STEP
        orders = (['a', 'b'], [1.0, 2.0]), (['b', 'a'], [2.0, 1.0])
        messages.append(('/joint_states', joint_state(now, *orders[step % 2]), now))
        target = make('std_msgs/msg/Float64MultiArray', layout=layout, data=np.array([3.0, 0.0]))
        messages.append(('/targets', target, now + 1))
    return write(tmp_path / 'bag', messages)


@pytest.mark.parametrize(
    ('how', 'action'),
    [('max_rate: 1', [1.0, 0.2]), ('reach: [4, 2]', [0.25, -0.5])],  # commanded: b, a
)
def test_joints_are_mapped_by_name(tmp_path, how, action):
    file = tmp_path / 'arm.yaml'
    file.write_text(ARM.replace('max_rate: 1', how))
    dataset = convert(file, reaching(tmp_path))
    assert dataset.observations.tolist() == [[1.0, 2.0]] * 5
    np.testing.assert_allclose(dataset.actions[:-1], [action] * 4, rtol=1e-6)


def test_command_out_of_reach_is_refused_and_not_clipped(tmp_path, capsys):
    file = tmp_path / 'arm.yaml'
    file.write_text(ARM.replace('max_rate: 1', 'reach: 0.9'))
    error = complaint(file, reaching(tmp_path), capsys)
    assert 'targets, message 1: commands [3.0, 0.0], further than [0.9, 0.9] from' in error
    assert 'the measured [2.0, 1.0]: widen reach in the contract' in error


def test_command_beyond_the_limits_is_refused_and_not_clipped(contract_file, tmp_path, capsys):
    bag = write(tmp_path / 'bag', drive(speed=1.2))
    error = complaint(contract_file, bag, capsys)
    assert f'{bag}: cmd_vel, message 1: commands [1.2, -1.0], outside the limits' in error


@pytest.mark.parametrize(
    ('messages', 'error'),
    [
        (drive()[::2], 'cmd_vel: not in the bag (there are: /odom (nav_msgs/msg/Odometry))'),
        (
            [*drive()[1::2], ('/odom', twist(0.0, 0.0), T0)],
            'odom: of type geometry_msgs/msg/Twist in the bag, not nav_msgs/msg/Odometry',
        ),
        (
            [(t, m, n + 100 * 10**9) for t, m, n in drive()],
            'no control period has both an observation and a command',
        ),
    ],
)
def test_bag_that_does_not_fit_is_refused(contract_file, tmp_path, capsys, messages, error):
    assert error in complaint(contract_file, write(tmp_path / 'bag', messages), capsys)


def test_missing_and_damaged_bags_are_named(contract_file, tmp_path, capsys):
    assert 'no such bag' in complaint(contract_file, tmp_path / 'none', capsys)
    [file] = files_of(write(tmp_path / 'bag', drive()))
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert f'{file}: cannot be read as a bag' in complaint(contract_file, file, capsys)
    file.write_text('text')
    assert f'{file}: cannot be read as a bag' in complaint(contract_file, file, capsys)


def test_existing_dataset_stays(contract_file, tmp_path, capsys):
    bag = write(tmp_path / 'bag', drive())
    convert(contract_file, bag)
    arguments = ['--contract', str(contract_file), '--bags', str(bag)]
    with pytest.raises(SystemExit, match='2'):
        main(['import-bags', *arguments, '--out', str(tmp_path / 'out.npz')])
    assert 'give --overwrite' in capsys.readouterr().err
    with pytest.raises(SystemExit, match='2'):
        main(['import-bags', '--contract', str(contract_file), '--out', str(tmp_path / 'x.npz')])
    assert 'no bags were given' in capsys.readouterr().err


class TestContractCheck:
    def check(self, contract_file: Path, bag: Path | None, capsys, status: int = 0):
        arguments = ['contract', 'check', str(contract_file)]
        arguments += ['--bag', str(bag)] if bag else []
        if status:
            with pytest.raises(SystemExit, match=str(status)):
                main(arguments)
        else:
            main(arguments)
        return capsys.readouterr()

    def test_says_what_is_read_and_written(self, contract_file, capsys):
        text = self.check(contract_file, None, capsys).out
        assert 'cart: 4 observed and 2 commanded values at 10 Hz' in text
        assert 'yaw.sin' in text
        assert 'cmd_vel without a command: fault zeros, silent zeros' in text

    def test_says_what_a_bag_holds(self, contract_file, tmp_path, capsys):
        text = self.check(contract_file, write(tmp_path / 'bag', drive()), capsys).out
        assert '20 of 20 periods have an observation; 19 transitions in 1 trajectories' in text
        assert ['odom', '20', '10.0', '0'] in [line.split() for line in text.splitlines()]

    @pytest.mark.parametrize(
        ('old', 'new', 'error'),
        [
            ('pose.position.x', 'pose.place.x', 'geometry_msgs/msg/Pose has no field place'),
            ('linear.x', 'linear', 'geometry_msgs/msg/Vector3 is no number'),
            ('pose.pose.orientation', 'pose.pose.position', 'a heading is read of a quaternion'),
            ('field: linear.x', 'field: linear.x, size: 1', 'one number has no joints'),
            ('{field: pose.pose.position.x, name: x', '{field: pose.covariance, name: x', 'array'),
            ('Twist\n', 'Twist\n    frame_id: base\n', 'frame_id: geometry_msgs/msg/Twist has no'),
            ('nav_msgs/msg/Odometry', 'nav_msgs/msg/Odo', 'type nav_msgs/msg/Odo is not known'),
            ('nav_msgs/msg/Odometry', 'geometry_msgs/msg/Pose', 'stamp header: geometry_msgs/ms'),
        ],
    )
    def test_fields_are_those_of_the_types(self, contract_file, capsys, old, new, error):
        assert old in DRIVE
        contract_file.write_text(DRIVE.replace(old, new, 1))
        assert error in self.check(contract_file, None, capsys, status=2).err

    def test_messages_that_do_not_fit_are_counted(self, contract_file, tmp_path, capsys):
        messages = drive()
        messages[4] = ('/odom', odometry(T0 + 2 * STEP, x=float('nan')), T0 + 2 * STEP)
        error = self.check(contract_file, write(tmp_path / 'bag', messages), capsys, 2).err
        assert '1 of 20 refused, first: odom: pose.pose.position.x is not finite' in error

    @pytest.mark.parametrize('name', ['arm6', 'diffdrive', 'quadruped', 'turtlebot3'])
    def test_starting_contracts_have_fields_of_their_types(self, name, capsys):
        root = Path(__file__).parents[3]
        self.check(root / 'config' / 'robots' / f'{name}.yaml', None, capsys)

    def test_wrong_contract_is_named_with_its_line(self, contract_file, capsys):
        contract_file.write_text(DRIVE.replace('rate_hz: 10', 'rate_hz: 0'))
        assert f'{contract_file}:3: rate_hz' in self.check(contract_file, None, capsys, 2).err


@pytest.mark.parametrize(
    ('storage', 'compression', 'reason'),
    [
        (StoragePlugin.MCAP, CompressionMode.STORAGE, 'a chunk announces '),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE, 'a message unpacks to more than 500 '),
        (StoragePlugin.SQLITE3, CompressionMode.FILE, 'unpacks to more than 500 bytes, half of'),
    ],
)
def test_what_is_compressed_is_not_unpacked_without_end(
    contract_file, tmp_path, monkeypatch, capsys, storage, compression, reason
):
    bag = write(tmp_path / 'bag', drive(), storage, compression)
    monkeypatch.setattr(unpacking, 'LARGEST_PART', 500)
    disk = SimpleNamespace(free=1000)
    monkeypatch.setattr(unpacking, 'shutil', SimpleNamespace(disk_usage=lambda _: disk))
    text = complaint(contract_file, bag, capsys)
    assert str(bag) in text
    assert reason in text
