from collections.abc import Callable
from pathlib import Path
import resource
import signal
from time import time_ns

from geometry_msgs.msg import PoseStamped
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from metagcttt.recorder.node import RecorderNode
from metagcttt.recorder.recording import (
    message_class,
    message_definition,
    Recording,
    UnknownTypeError,
)
from metagcttt.sim.node import SimBridgeNode
from metagcttt_core import TrajectoryDataset
from metagcttt_interfaces.action import ReachGoal
from metagcttt_tools import import_recordings as recording_to_dataset
from metagcttt_tools.graph.process import NodeProcess
from metagcttt_tools.recordings.mcap import read_messages
from metagcttt_tools.recordings.trajectories import STATE
import numpy as np
import pytest
from rcl_interfaces.msg import Log
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from std_msgs.msg import Bool, Float64, String
from tests.ros.graph import ANY, EVERY, Graph, Record
from tests.ros.test_lockstep_episode import drive, offline_episode, TTT
import yaml


def contents(path: Path) -> dict[str, list]:
    """Decoded messages by topic, read as other programs do, through the file's index."""
    messages: dict[str, list] = {}
    with path.open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == 'ros2'
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ('ros2msg', 'cdr')
            messages.setdefault(channel.topic, []).append(message)
    return messages


def wait_until_recorded(graph: Graph, *topics: str) -> None:
    for topic in topics:
        graph.wait(
            lambda topic=topic: any(
                info.node_name == 'recorder_node'
                for info in graph.node.get_subscriptions_info_by_topic(topic)
            ),
            f'the recorder at {topic}',
            timeout_s=60,
        )


@pytest.mark.mujoco
@pytest.mark.slow
def test_recorded_lockstep_episode_is_the_offline_episode(
    graph: Graph,
    tmp_path: Path,
    checkpoint_folder: Path,
    dataset_file: Path,
    start_process: Callable[..., NodeProcess],
) -> None:
    output, converted = tmp_path / 'run.mcap', tmp_path / 'run.npz'
    files = {'dataset': dataset_file, 'stepping': 'lockstep'}
    policy = {'checkpoint': checkpoint_folder, 'adaptation': 'hold', 'threads': 1, **TTT}
    start_process('sim_bridge_node', stepping='lockstep')
    start_process('goal_node', **files)
    start_process('policy_node', **policy, **files)
    recorder = start_process('recorder_node', output=output)
    record = Record(graph, EVERY)
    graph.wait_for_publishers()
    wait_until_recorded(graph, '/state', '/action', '/goal', '/episode', '/adaptation', '/map')
    graph.wait(lambda: graph.node.count_subscribers('goal') == 3, 'policy and recorder')
    for task_id, seed in ((1, 3), (4, 8)):
        drive(graph, record, task_id, seed)
    # On a busy machine DDS loses packets and sends them again, at the latest after three seconds.
    graph.wait_for(4.0)
    assert recorder.stop() == 0

    argv = ['--recordings', str(output), '--out', str(converted), '--refuse-gaps']
    recording_to_dataset.main(argv)
    dataset = TrajectoryDataset.load(converted)
    expected = [
        offline_episode(checkpoint_folder, dataset_file, task_id, seed)
        for task_id, seed in ((1, 3), (4, 8))
    ]
    assert dataset.num_episodes == 2
    for number, episode in enumerate(expected):
        rows = slice(dataset.episode_starts[number], dataset.episode_ends[number] + 1)
        np.testing.assert_array_equal(
            dataset.observations[rows], episode.observations.astype(np.float32)
        )
        np.testing.assert_array_equal(dataset.actions[rows][:-1], episode.actions)

    recorded = contents(output)
    assert {'/state', '/action', '/goal', '/episode', '/adaptation', '/map', '/clock'} <= set(
        recorded
    )
    assert len(recorded['/adaptation']) == 2
    assert recorded['/map'][0].info.width == 8


@pytest.mark.mujoco
@pytest.mark.slow
def test_killed_recorder_leaves_a_readable_file(
    graph: Graph, tmp_path: Path, start_process: Callable[..., NodeProcess]
) -> None:
    output = tmp_path / 'run.mcap'
    graph.add(SimBridgeNode, speed_factor=5.0)
    recorder = start_process('recorder_node', output=output, flush_s=0.1)
    wait_until_recorded(graph, '/state')
    graph.wait(lambda: output.stat().st_size > 5000, 'the first chunks')
    recorder.kill()
    content = read_messages(output, [STATE])
    assert not content.complete
    steps = [recorded.message.step for recorded in content.messages]
    assert len(steps) > 3
    assert steps == list(range(steps[0], steps[0] + len(steps)))


def test_recorder_takes_on_the_quality_of_the_publishers(graph: Graph, tmp_path: Path) -> None:
    output = tmp_path / 'run.mcap'
    recorder = graph.add(RecorderNode, output=str(output))
    first = graph.node.create_publisher(Float64, 'number', EVERY)
    first.publish(Float64(data=1.0))
    graph.wait(lambda: recorder._recording.num_messages == 1, 'the latched message')
    graph.node.destroy_publisher(first)
    second = graph.node.create_publisher(Float64, 'number', ANY)
    graph.wait(second.get_subscription_count, 'a subscription that fits')
    second.publish(Float64(data=2.0))
    graph.wait(lambda: recorder._recording.num_messages == 2, 'the second message')
    graph.remove(recorder)
    assert [message.data for message in contents(output)['/number']] == [1.0, 2.0]


def test_recorder_never_hears_an_order(graph: Graph, tmp_path: Path) -> None:
    """`ros2 topic pub --once` would take it for the node that the order is for."""
    recorder = graph.add(RecorderNode, output=str(tmp_path / 'run.mcap'))
    orders = [
        graph.node.create_publisher(PoseStamped, 'goal_pose', 1),
        graph.node.create_publisher(PoseStamped, '/robot1/goal_pose', 1),
        graph.node.create_publisher(Bool, 'stop', 1),
    ]
    graph.node.create_publisher(Float64, 'number', EVERY).publish(Float64(data=1.0))
    graph.wait(lambda: recorder._recording.num_messages == 1, 'a message that is no order')
    assert not any(publisher.get_subscription_count() for publisher in orders)


@pytest.mark.parametrize('hidden_topics', [False, True])
def test_feedback_of_actions_is_recorded_when_asked_for_and_never_warned_of(
    graph: Graph, tmp_path: Path, hidden_topics: bool
) -> None:
    output = tmp_path / 'run'
    recorder = graph.add(RecorderNode, output=str(output), hidden_topics=hidden_topics)
    logged = graph.collect(Log, '/rosout')
    kind = ReachGoal.Impl.FeedbackMessage
    publisher = graph.node.create_publisher(kind, 'reach_goal/_action/feedback', EVERY)
    feedback = kind()
    feedback.goal_id.uuid[3] = 7
    feedback.feedback.steps = 12
    for _ in range(3):
        publisher.publish(feedback)
    graph.node.create_publisher(Float64, 'number', EVERY).publish(Float64(data=1.0))
    number = 4 if hidden_topics else 1
    graph.wait(lambda: recorder._recording.num_messages == number, 'the messages')
    graph.remove(recorder)
    assert not [log.msg for log in logged if log.level > Log.INFO]
    with AnyReader([output]) as reader:
        read = [
            (connection.topic, reader.deserialize(data, connection.msgtype))
            for connection, _, data in reader.messages()
        ]
    told = [m for topic, m in read if topic == '/reach_goal/_action/feedback']
    assert [(m.goal_id.uuid[3], m.feedback.steps) for m in told] == [(7, 12)] * (number - 1)


def test_recorder_in_a_namespace_leaves_other_robots_out(graph: Graph, tmp_path: Path) -> None:
    output = tmp_path / 'run.mcap'
    mine = graph.node.create_publisher(String, '/robot1/word', EVERY)
    other = graph.node.create_publisher(String, '/robot10/word', EVERY)
    shared = graph.node.create_publisher(String, '/diagnostics', EVERY)
    for publisher in (mine, other, shared):
        publisher.publish(String(data='here'))
    recorder = graph.add(
        lambda **kwargs: RecorderNode(namespace='robot1', **kwargs), output=str(output)
    )
    graph.wait(lambda: recorder._recording.num_messages == 2, 'two messages')
    graph.remove(recorder)
    assert contents(output).keys() == {'/robot1/word', '/diagnostics'}


def test_recording_is_split_at_its_size(tmp_path: Path) -> None:
    recording = Recording(tmp_path / 'run.mcap', split_bytes=4000)
    recording.add_topic('/word', 'std_msgs/msg/String')
    rng = np.random.default_rng(0)
    text = b'\x00\x01\x00\x00\x65\x00\x00\x00'
    for time in range(100):
        letters = rng.integers(97, 123, 100).astype(np.uint8).tobytes()
        recording.add('/word', text + letters + b'\x00', log_time=time, publish_time=time)
        recording.flush()
    recording.close()
    assert [path.name for path in recording.paths[:3]] == [
        'run.mcap',
        'run_1.mcap',
        'run_2.mcap',
    ]
    counts = [len(contents(path)['/word']) for path in recording.paths]
    assert sum(counts) == recording.num_messages == 100


def test_bag_folder_is_what_rosbag2_describes(graph: Graph, tmp_path: Path) -> None:
    output = tmp_path / 'run'
    recorder = graph.add(RecorderNode, output=str(output), split_mb=0.000001)
    publisher = graph.node.create_publisher(Float64, 'number', EVERY)
    before = time_ns()
    for number in range(3):
        publisher.publish(Float64(data=float(number)))
        graph.wait(lambda n=number: recorder._recording.num_messages > n, 'the message')
        recorder._recording.flush()
    graph.remove(recorder)
    with AnyReader([output]) as reader:
        values = [
            reader.deserialize(data, connection.msgtype).data
            for connection, _, data in reader.messages()
        ]
        assert values == [0.0, 1.0, 2.0]
        assert before <= reader.start_time <= reader.end_time <= time_ns()
        [connection] = reader.connections
        assert connection.digest.startswith('RIHS01_')
        [qos] = connection.ext.offered_qos_profiles
        assert (qos.reliability.name, qos.durability.name) == ('RELIABLE', 'TRANSIENT_LOCAL')
    text = (output / 'metadata.yaml').read_text(encoding='utf-8')
    metadata = yaml.safe_load(text)['rosbag2_bagfile_information']
    names = [f'run_{number}.mcap' for number in range(4)]
    assert metadata['relative_file_paths'] == names
    assert [file['path'] for file in metadata['files']] == names
    assert [file['message_count'] for file in metadata['files']] == [0, 1, 1, 1]
    assert (metadata['version'], metadata['message_count']) == (9, 3)
    assert metadata['storage_identifier'] == 'mcap'


def test_metadata_has_the_fields_that_rosbags_writes(tmp_path: Path) -> None:
    """Neither more nor fewer, at every depth, so that `ros2 bag info` finds what it looks for."""
    recording = Recording(tmp_path / 'ours')
    recording.add_topic('/word', 'std_msgs/msg/String', [EVERY], 'RIHS01_00')
    recording.add('/word', b'\x00\x01\x00\x00\x01\x00\x00\x00\x00', log_time=5, publish_time=4)
    recording.close()
    with Writer(tmp_path / 'theirs', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        types = get_typestore(Stores.ROS2_JAZZY)
        never = QosTime(0, 0)
        profile = Qos(
            *(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL),
            *(never, never, QosLiveliness.AUTOMATIC, never, False),
        )
        topic = writer.add_connection(
            '/word', 'std_msgs/msg/String', typestore=types, offered_qos_profiles=[profile]
        )
        writer.write(topic, 5, b'\x00\x01\x00\x00\x01\x00\x00\x00\x00')

    def shape(content):
        if isinstance(content, dict):
            return {key: shape(value) for key, value in content.items()}
        return [shape(value) for value in content] if isinstance(content, list) else None

    ours, theirs = (
        yaml.safe_load((tmp_path / name / 'metadata.yaml').read_text(encoding='utf-8'))
        for name in ('ours', 'theirs')
    )
    assert shape(ours) == shape(theirs)


@pytest.mark.parametrize('name', ['run.mcap', 'run'])
def test_recording_never_overwrites(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b'precious')
    with pytest.raises(FileExistsError, match=name):
        Recording(path)
    assert path.read_bytes() == b'precious'


def test_recording_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r'run\.db3: bags are written as \.mcap'):
        Recording(tmp_path / 'run.db3')
    assert not list(tmp_path.iterdir())


def test_definition_holds_every_type_in_a_message() -> None:
    text = message_definition('metagcttt_interfaces/msg/MazeState')
    assert text.startswith('# What the simulator')
    for name in ('std_msgs/Header', 'builtin_interfaces/Time', 'geometry_msgs/Point'):
        assert text.count(f'{"=" * 80}\nMSG: {name}\n') == 1


@pytest.mark.parametrize('name', ['std_srvs/srv/Trigger', 'nowhere/msg/Thing', 'std_msgs/msg/No'])
def test_unknown_type_is_refused_by_name(name: str) -> None:
    with pytest.raises(UnknownTypeError, match=name):
        message_class(name)


@pytest.mark.parametrize('name', ['run.mcap', 'run'])
def test_full_disk_loses_what_comes_meanwhile_and_nothing_before_or_after(
    tmp_path: Path, name: str
) -> None:
    rng = np.random.default_rng(0)

    def add(stamps: range) -> None:
        for stamp in stamps:
            data = serialize_message(String(data=f'{stamp} {rng.bytes(2000).hex()}'))
            recording.add('/text', data, log_time=stamp, publish_time=stamp)

    recording = Recording(tmp_path / name)
    recording.add_topic('/text', 'std_msgs/msg/String')
    add(range(1, 11))
    recording.flush()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (recording.paths[0].stat().st_size, limits[1]))
        add(range(11, 14))
        with pytest.raises(OSError, match='File too large'):
            recording.flush()
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
        add(range(14, 16))
        for _ in range(2):
            with pytest.raises(OSError, match='File too large'):
                recording.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
    recording.flush()
    add(range(16, 21))
    recording.close()
    assert recording.num_lost == 2
    first, second = recording.paths
    found = [
        [int(recorded.message.data.split()[0]) for recorded in read.messages]
        for read in (read_messages(path, ('std_msgs/msg/String',)) for path in (first, second))
    ]
    assert found == [list(range(1, 11)), list(range(16, 21))]
    assert [path.name for path in sorted(first.parent.glob('*.mcap'))] == [first.name, second.name]
