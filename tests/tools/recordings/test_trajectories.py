"""Recordings written with the mcap packages alone, as any other program would."""

from pathlib import Path

from mcap_ros2.writer import Writer
from metagcttt_core.data import DatasetError
from metagcttt_tools.recordings.trajectories import ACTION, join_datasets, read_recordings, STATE
import numpy as np
import pytest

STATE_TEXT = 'uint32 episode_id\nuint32 step\nfloat64[] observation\n'
ACTION_TEXT = 'uint32 episode_id\nuint32 step\nuint32 query_id\nfloat64[] values\n'


class Bag:
    """Writes states and actions, each published a millisecond after the last."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open('wb')
        self._writer = Writer(self._file)
        self._state = self._writer.register_msgdef(STATE, STATE_TEXT)
        self._action = self._writer.register_msgdef(ACTION, ACTION_TEXT)
        self._time = 0

    def _write(self, topic, schema, message) -> None:
        self._time += 10**6
        self._writer.write_message(topic, schema, message, self._time, self._time)

    def state(self, step, observation=None, *, episode=1, robot='') -> None:
        values = [float(step), 10.0 * episode] if observation is None else observation
        message = {'episode_id': episode, 'step': step, 'observation': values}
        self._write(f'{robot}/state', self._state, message)

    def action(self, step, values=None, *, episode=1, query=1, robot='') -> None:
        message = {'episode_id': episode, 'step': step, 'query_id': query}
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
