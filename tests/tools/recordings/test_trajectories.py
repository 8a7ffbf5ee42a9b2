"""Recordings written with the mcap packages alone, as any other program would."""

from pathlib import Path

import lz4.frame
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, Header
from mcap.writer import MCAP0_MAGIC
from mcap_ros2.writer import Writer
from metagcttt_core.data import DatasetError
from metagcttt_tools.recordings.trajectories import ACTION, join_datasets, read_recordings, STATE
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
import zstandard

STATE_TEXT = (
    'std_msgs/Header header\nuint32 episode_id\nuint32 step\nfloat64[] observation\n'
    + '=' * 80
    + '\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n'
    + '=' * 80
    + '\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n'
)
ACTION_TEXT = (
    'uint32 episode_id\nuint32 step\nuint32 query_id\nfloat64[] values\nuint64 instance\n'
)


class Bag:
    """Writes states and actions, each published a millisecond after the last.

    Attributes:
        clock_ns: Time by the recorder's clock, to be changed at will.
        ahead_ns: What the publishers' clock is ahead of that.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open('wb')
        self._writer = Writer(self._file)
        self._state = self._writer.register_msgdef(STATE, STATE_TEXT)
        self._action = self._writer.register_msgdef(ACTION, ACTION_TEXT)
        self.clock_ns = 10**12
        self.ahead_ns = 0

    def _write(self, topic, schema, message) -> None:
        self.clock_ns += 10**6
        published_ns = self.clock_ns + self.ahead_ns
        self._writer.write_message(topic, schema, message, self.clock_ns, published_ns)

    def state(self, step, observation=None, *, episode=1, robot='', stamp_s=None) -> None:
        values = [float(step), 10.0 * episode] if observation is None else observation
        stamp_ns = round(1e9 * (0.1 * step if stamp_s is None else stamp_s))
        stamp = dict(zip(('sec', 'nanosec'), divmod(stamp_ns, 10**9), strict=True))
        message = {'header': {'stamp': stamp, 'frame_id': 'map'}, 'episode_id': episode}
        message |= {'step': step, 'observation': values}
        self._write(f'{robot}/state', self._state, message)

    def action(self, step, values=None, *, episode=1, query=1, robot='', instance=7) -> None:
        message = {'episode_id': episode, 'step': step, 'query_id': query, 'instance': instance}
        message['values'] = [step / 10, 0.5] if values is None else values
        self._write(f'{robot}/action', self._action, message)

    def walk(self, steps, **kwargs) -> None:
        for step in range(steps.start, steps.stop):
            self.state(step, **kwargs)
            self.action(step, **kwargs)

    def close(self) -> Path:
        self._writer.finish()
        self._file.close()
        return self.path


@pytest.fixture
def bag(tmp_path: Path) -> Bag:
    return Bag(tmp_path / 'run.mcap')


def test_state_goes_with_the_action_that_follows_it(bag) -> None:
    bag.walk(range(0, 3))
    bag.state(3)
    dataset, summary = read_recordings([bag.close()])
    np.testing.assert_array_equal(dataset.observations, [[0, 10], [1, 10], [2, 10], [3, 10]])
    expected = np.array([[0, 0.5], [0.1, 0.5], [0.2, 0.5], [0, 0]], np.float32)
    np.testing.assert_array_equal(dataset.actions, expected)
    assert dataset.terminals.tolist() == [False, False, False, True]
    assert (summary.states, summary.actions, summary.transitions) == (4, 3, 3)
    assert (summary.dropped, summary.unfinished) == ({}, [])


def test_episodes_are_trajectories(bag) -> None:
    bag.walk(range(0, 2))
    bag.state(2)
    bag.walk(range(0, 3), episode=2)
    bag.state(3, episode=2)
    dataset, _ = read_recordings([bag.close()])
    assert dataset.episode_ends.tolist() == [2, 6]


def test_last_of_several_actions_for_a_state_counts(bag) -> None:
    bag.state(0)
    bag.action(0, [0.1, 0.1])
    bag.action(0, [0.2, 0.2])
    bag.state(1)
    bag.action(0, [0.3, 0.3])
    dataset, summary = read_recordings([bag.close()])
    np.testing.assert_array_equal(dataset.actions[0], np.float32([0.2, 0.2]))
    assert summary.dropped == {'actions for another state than the last one': 1}


@pytest.mark.parametrize(
    ('spoil', 'reason'),
    [
        (lambda bag: bag.walk(range(4, 6)), 'gaps between states'),
        (lambda bag: (bag.state(2), bag.walk(range(3, 6))), 'states without an action'),
        (lambda bag: bag.walk(range(0, 2)), 'steps back in time'),
        (lambda bag: (bag.state(2), bag.action(2, query=0), bag.walk(range(3, 6))), 'idle steps'),
        (lambda bag: (bag.state(2, [np.nan, 0.0]), bag.walk(range(3, 6))), 'gaps between states'),
    ],
)
def test_trajectory_is_cut_and_counted(bag, spoil, reason: str) -> None:
    bag.walk(range(0, 2))
    spoil(bag)
    path = bag.close()
    dataset, summary = read_recordings([path])
    assert dataset.num_episodes == 2
    assert summary.dropped[reason] == 1
    if reason != 'idle steps':
        with pytest.raises(DatasetError, match=f'/: {reason} after step . of episode 1'):
            read_recordings([path], refuse_gaps=True)


def test_trajectory_is_cut_where_a_clock_jumps(bag) -> None:
    bag.walk(range(0, 20))
    for clock_s, ahead_s in ((-5, 0), (3600, 0), (0, 60), (0, -60)):
        bag.clock_ns += clock_s * 10**9
        bag.ahead_ns += ahead_s * 10**9
        first = bag.next_step = getattr(bag, 'next_step', 0) + 20
        bag.walk(range(first, first + 20))
    dataset, summary = read_recordings([bag.close()])
    assert dataset.observations[:, 0].tolist() == list(range(100))
    assert dataset.episode_ends.tolist() == [19, 39, 59, 79, 99]
    assert summary.dropped == {'jumps of a clock': 4}


def test_messages_that_waited_for_the_recorder_are_no_jump(bag) -> None:
    bag.ahead_ns = -(10**12)
    for step in range(0, 40):
        bag.ahead_ns = min(bag.ahead_ns + 30 * 10**9, 0)
        bag.walk(range(step, step + 1))
    assert read_recordings([bag.close()], refuse_gaps=True)[0].num_episodes == 1


@pytest.mark.parametrize('stamp_s', [1e9, 0.0, 3.0])
def test_trajectory_is_cut_where_a_stamp_is_of_another_clock(bag, stamp_s) -> None:
    bag.walk(range(0, 6))
    for step in range(6, 12):
        bag.state(step, stamp_s=stamp_s + 0.1 * step)
        bag.action(step)
    dataset, summary = read_recordings([bag.close()])
    expected = {} if not stamp_s else {'jumps of the stamps': 1}
    assert (dataset.num_episodes, summary.dropped) == (1 + len(expected), expected)


def test_steps_that_two_simulators_publish_are_left_out(bag) -> None:
    """A true transition is from s to s + 1 in both values."""
    bag.walk(range(0, 10))
    for step in range(10, 14):  # another robot one step ahead, on the same topic
        bag.state(step, [step, 10.0])
        bag.action(step)
        bag.state(step + 1, [step + 1, 99.0])
        bag.action(step + 1)
    bag.walk(range(14, 30))
    dataset, summary = read_recordings([bag.close()])
    inside = ~dataset.terminals[:-1]
    changes = np.diff(dataset.observations, axis=0)[inside]
    np.testing.assert_array_equal(changes, np.tile([1, 0], (len(changes), 1)))
    assert summary.dropped['transitions to a state that was recorded twice'] == 4
    assert summary.dropped['steps back in time'] == 4
    assert dataset.num_transitions == 10 + 15


def test_steps_with_two_policies_are_left_out_as_long_as_the_simulator_stands(bag) -> None:
    bag.walk(range(0, 3))
    bag.action(2, instance=8)
    bag.walk(range(3, 5))
    bag.clock_ns += 2 * 10**9
    bag.walk(range(5, 9))
    dataset, summary = read_recordings([bag.close()])
    assert summary.dropped == {'steps with several senders of actions': 2}
    assert dataset.observations[:, 0].tolist() == [0, 1, 2, 4, 5, 6, 7, 8]


def test_recording_that_is_mostly_a_mixture_is_refused(bag) -> None:
    bag.walk(range(0, 3))
    for step in range(3, 40):
        for world in (0.0, 50.0):
            bag.state(step, [world, world])
            bag.action(step)
    with pytest.raises(DatasetError, match=r'\d+ of \d+ steps do not follow .*one robot'):
        read_recordings([bag.close()])


def test_recording_whose_actions_are_of_another_clock_is_refused(bag) -> None:
    bag.walk(range(0, 30))
    bag.ahead_ns = 500 * 10**6
    for step in range(30, 100):
        bag.ahead_ns = 0
        bag.state(step)
        bag.ahead_ns = 500 * 10**6
        bag.action(step)
    with pytest.raises(DatasetError, match=r'69 of 100 actions .* different clocks'):
        read_recordings([bag.close()])


def test_files_of_different_recordings_are_not_joined(tmp_path: Path) -> None:
    first, second = Bag(tmp_path / 'a.mcap'), Bag(tmp_path / 'b.mcap')
    second.clock_ns += 3600 * 10**9
    first.walk(range(0, 3))
    second.walk(range(3, 6))
    dataset, summary = read_recordings([first.close(), second.close()], refuse_gaps=True)
    assert (dataset.episode_ends.tolist(), summary.dropped) == ([2, 5], {})


def test_idle_steps_can_be_kept(bag) -> None:
    bag.state(0)
    bag.action(0, query=0)
    bag.state(1)
    path = bag.close()
    assert read_recordings([path], keep_idle=True)[0].num_transitions == 1
    with pytest.raises(DatasetError, match='no step with an action; left out: 1 idle steps'):
        read_recordings([path])


def test_standing_still_after_the_end_is_not_a_gap(bag) -> None:
    bag.walk(range(0, 2))
    for _ in range(3):
        bag.state(2)
    dataset, summary = read_recordings([bag.close()], refuse_gaps=True)
    assert (dataset.num_rows, summary.dropped) == (3, {'repeated states': 2})


def test_robots_of_one_recording_are_kept_apart(bag) -> None:
    for step in range(3):
        for robot, episode in (('/robot1', 1), ('/robot2', 7)):
            bag.state(step, robot=robot, episode=episode)
            bag.action(step, robot=robot, episode=episode)
    dataset, _ = read_recordings([bag.close()], refuse_gaps=True)
    assert dataset.observations[:, 1].tolist() == [10, 10, 10, 70, 70, 70]


def test_trajectory_goes_on_in_the_next_file_of_a_split(tmp_path: Path) -> None:
    first, second = Bag(tmp_path / 'a.mcap'), Bag(tmp_path / 'a_1.mcap')
    first.walk(range(0, 3))
    second.walk(range(3, 6))
    dataset, _ = read_recordings([first.close(), second.close()], refuse_gaps=True)
    assert dataset.num_episodes == 1


def test_killed_recorder_leaves_what_it_had_written(bag) -> None:
    bag.walk(range(0, 100))
    bag._writer._writer.flush()
    bag.walk(range(100, 200))
    content = bag.close().read_bytes()
    end = content.index(b'\x00' * 8, len(content) // 3)
    kept = []
    for size in (end, len(content) * 2 // 3, len(content) - 5):
        bag.path.write_bytes(content[:size])
        dataset, summary = read_recordings([bag.path])
        assert summary.unfinished == [bag.path]
        kept.append(dataset.num_rows)
    assert kept[-1] == 200
    assert set(kept) <= {100, 200}


@pytest.mark.parametrize(
    ('content', 'message'),
    [(b'not a recording at all', 'not an MCAP file'), (None, 'no such file')],
)
def test_file_that_is_no_recording_is_refused(tmp_path, content, message) -> None:
    path = tmp_path / 'run.mcap'
    if content:
        path.write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        read_recordings([path])


def test_damaged_recording_is_refused(bag) -> None:
    bag.walk(range(0, 50))
    content = bytearray(bag.close().read_bytes())
    content[len(content) // 4] ^= 0xFF
    bag.path.write_bytes(content)
    with pytest.raises(DatasetError, match=r'damaged|needs topics'):
        read_recordings([bag.path])


@pytest.mark.parametrize('compression', ['', 'lz4', 'zstd'])
@pytest.mark.parametrize('announced', [10, 1 << 40])
def test_chunk_is_unpacked_only_as_far_as_it_says(
    tmp_path, compression, announced, bounded_memory
) -> None:
    compress = {'': bytes, 'lz4': lz4.frame.compress, 'zstd': zstandard.compress}[compression]
    builder = RecordBuilder()
    Header(profile='ros2', library='').write(builder)
    Chunk(
        compression=compression,
        data=compress(bytes(1 << 26)),
        message_start_time=0,
        message_end_time=0,
        uncompressed_crc=0,
        uncompressed_size=announced,
    ).write(builder)
    (tmp_path / 'run.mcap').write_bytes(MCAP0_MAGIC + builder.end())
    with pytest.raises(DatasetError, match=r'does not unpack to 10|at most 268435456 are read'):
        read_recordings([tmp_path / 'run.mcap'])


def test_recording_without_the_topics_is_refused_with_those_it_has(bag) -> None:
    bag.state(0)
    with pytest.raises(DatasetError, match=r'ActionCommand, got /state \(metagcttt_interfaces'):
        read_recordings([bag.close()])


def test_vectors_of_different_length_are_refused(bag) -> None:
    bag.walk(range(0, 2))
    bag.state(2, [1.0, 2.0, 3.0])
    with pytest.raises(DatasetError, match='vectors of 2 and 3 values in episode 1'):
        read_recordings([bag.close()])


def test_datasets_are_joined_trajectory_by_trajectory(bag) -> None:
    bag.walk(range(0, 4))
    dataset, _ = read_recordings([bag.close()])
    joined = join_datasets([dataset, dataset])
    assert joined.episode_ends.tolist() == [3, 7]


def same_bag(source: Path, path: Path, plugin: StoragePlugin, compress: bool = False) -> Path:
    """A recording as another program would keep it, in a folder."""
    writer = Writer2(path, version=9, storage_plugin=plugin)
    if compress:
        writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with AnyReader([source]) as reader, writer:
        topics = {
            each.id: writer.add_connection(each.topic, each.msgtype, typestore=reader.typestore)
            for each in reader.connections
        }
        for connection, time_ns, data in reader.messages():
            writer.write(topics[connection.id], time_ns, data)
    return path


@pytest.mark.parametrize('form', ['mcap', 'sqlite3', 'compressed', 'bare db3', 'no metadata'])
def test_bag_in_any_form_is_the_same_recording(bag, tmp_path: Path, form: str) -> None:
    bag.walk(range(0, 4))
    bag.clock_ns += 10**12  # a jump
    bag.walk(range(4, 8))
    expected, told = read_recordings([bag.close()])
    plugin = StoragePlugin.SQLITE3 if form in ('sqlite3', 'bare db3') else StoragePlugin.MCAP
    path = same_bag(bag.path, tmp_path / 'folder', plugin, compress=form == 'compressed')
    if form == 'bare db3':
        [path] = path.glob('*.db3')
    if form == 'no metadata':
        (path / 'metadata.yaml').unlink()
    dataset, summary = read_recordings([path])
    np.testing.assert_array_equal(dataset.observations, expected.observations)
    np.testing.assert_array_equal(dataset.actions, expected.actions)
    np.testing.assert_array_equal(dataset.episode_starts, expected.episode_starts)
    assert dataset.num_episodes == 2
    assert summary.dropped == told.dropped


@pytest.mark.parametrize(
    ('content', 'reason'),
    [('', 'cannot be read'), ('a: [', 'cannot be read'), ('[1]', 'cannot be read')],
)
def test_folder_with_false_metadata_is_refused(tmp_path: Path, content: str, reason: str) -> None:
    (tmp_path / 'metadata.yaml').write_text(content, encoding='utf-8')
    with pytest.raises(DatasetError, match=f'metadata.yaml: {reason}'):
        read_recordings([tmp_path])


def test_folder_or_file_that_is_no_bag_is_refused(tmp_path: Path) -> None:
    (tmp_path / 'a.db3').write_bytes(b'SQLite format 3\x00 and nothing')
    for path in (tmp_path, tmp_path / 'a.db3', tmp_path / 'missing.db3'):
        with pytest.raises(DatasetError, match=path.name):
            read_recordings([path])
