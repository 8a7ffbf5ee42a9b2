from collections.abc import Callable, Iterator
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from ament_index_python import get_package_prefix
from metagcttt_core.config.assets import assets_dir
from metagcttt_interfaces.msg import EpisodeEvent
from metagcttt_tools.graph.process import NodeProcess
import pytest

from tests.ros.graph import ANY, goal_pose, Graph, Record

EXECUTABLES = Path(get_package_prefix('metagcttt')) / 'lib' / 'metagcttt'
NODES = (
    *('goal_node', 'policy_node', 'recorder_node', 'robot_bridge_node', 'sim_bridge_node'),
    'visualization_node',
)
CONTRACT = Path(__file__).parents[2] / 'config' / 'robots' / 'turtlebot3.yaml'


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recorder writes into the folder it is started in."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def start(ros_domain: int) -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts executables whose output and errors the test wants to see apart."""
    processes = []

    def start(*command: str, **environment: str) -> subprocess.Popen:
        processes.append(
            subprocess.Popen(
                [str(EXECUTABLES / command[0]), *command[1:]],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
                # Log lines to stdout, so that anything on stderr is an error.
                env={**os.environ, 'RCUTILS_LOGGING_USE_STDOUT': '1', **environment},
            )
        )
        return processes[-1]

    yield start
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def arguments(node: str, checkpoint: Path, dataset: Path) -> list[str]:
    both = [f'dataset:={dataset}', f'checkpoint:={checkpoint}']
    given = {
        'goal_node': both[:1],
        'policy_node': both,
        'robot_bridge_node': [f'contract:={CONTRACT}'],
        'visualization_node': both,
    }.get(node, [])
    return [word for parameter in given for word in ('-p', parameter)]


def wait_for_node(graph: Graph, name: str) -> None:
    graph.wait(lambda: name in graph.node.get_node_names(), name, timeout_s=60)


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM], ids=['ctrl-c', 'sigterm'])
@pytest.mark.parametrize('node', NODES)
def test_signal_ends_the_node_cleanly(
    graph: Graph, start, node: str, number: int, checkpoint_folder: Path, dataset_file: Path
) -> None:
    process = start(node, '--ros-args', *arguments(node, checkpoint_folder, dataset_file))
    wait_for_node(graph, node)
    if node == 'sim_bridge_node':  # has imported glfw, whose own script would speak up too
        graph.wait(lambda: graph.node.count_publishers('state'), 'the simulator', timeout_s=60)
    os.killpg(process.pid, number)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, ''), output


@pytest.mark.slow
def test_signal_during_the_start_ends_the_node_cleanly(
    start, checkpoint_folder: Path, dataset_file: Path
) -> None:
    given = arguments('policy_node', checkpoint_folder, dataset_file)
    process = start('policy_node', '--ros-args', *given)
    # Handlers are in place before PyTorch, which takes seconds, is imported.
    status = Path(f'/proc/{process.pid}/status')
    deadline = time.monotonic() + 60
    while not catches(status, signal.SIGTERM):
        assert process.poll() is None
        assert time.monotonic() < deadline
    os.killpg(process.pid, signal.SIGTERM)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, ''), output


def catches(status: Path, number: int) -> bool:
    """Whether a process has a handler of its own for a signal, by its /proc/PID/status."""
    mask = next(line for line in status.read_text().splitlines() if line.startswith('SigCgt'))
    return bool(int(mask.split()[1], 16) >> (number - 1) & 1)


@pytest.mark.slow
def test_nodes_end_with_the_program_that_started_them(graph: Graph, tmp_path: Path) -> None:
    program = f"""
import pathlib, time
from metagcttt_tools.graph.process import NodeProcess
NodeProcess('recorder_node', {{'output': '{tmp_path}/all.mcap'}}, pathlib.Path('{tmp_path}/log'))
time.sleep(600)
"""
    owner = subprocess.Popen([sys.executable, '-c', program], cwd=Path(__file__).parents[2])
    try:
        wait_for_node(graph, 'recorder_node')
    finally:
        owner.kill()
        owner.wait()
    graph.wait(lambda: 'recorder_node' not in graph.node.get_node_names(), 'the end of the node')


@pytest.mark.parametrize(
    ('command', 'message'),
    [
        (
            ['sim_bridge_node', '--ros-args', '-p', 'environment:=pointmaze-medum-v0'],
            "cannot start: unknown environment 'pointmaze-medum-v0', did you mean",
        ),
        (
            ['sim_bridge_node', '--ros-args', '-p', 'speed_factor:=-1.0'],
            'speed_factor',
        ),
        (
            ['sim_bridge_node', '--ros-args', '-p', 'stepping:=fast'],
            "stepping must be one of realtime, lockstep, got 'fast'",
        ),
        (
            ['goal_node', '--ros-args', '-p', 'dataset:=/nowhere.npz'],
            'cannot start: /nowhere.npz',
        ),
    ],
)
def test_node_that_cannot_start_says_why(start, command: list[str], message: str) -> None:
    process = start(*command)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (1, '')
    assert message in output


@pytest.mark.slow
def test_goal_pose_moves_the_robot_in_realtime(
    graph: Graph, start_process: Callable[..., NodeProcess], dataset_file: Path, checkpoint_folder
) -> None:
    start_process('sim_bridge_node', speed_factor=5.0)
    start_process('goal_node', dataset=dataset_file)
    start_process(
        'policy_node',
        dataset=dataset_file,
        checkpoint=checkpoint_folder,
        adapt_steps=20,
        adapt_batch_size=64,
        rate_hz=100.0,
        use_sim_time=True,
    )
    record = Record(graph, ANY)
    graph.wait(lambda: record.actions, 'the first action', timeout_s=60)
    graph.set_task(1, send_goal=False)
    first = graph.wait(
        lambda: next((s for s in record.states if s.episode_id == 2), None), 'the task'
    )
    graph.publish('goal_pose', goal_pose(first.position.x, first.position.y + 4.0))
    graph.wait(
        lambda: any(
            e.kind in (EpisodeEvent.GOAL_ACCEPTED, EpisodeEvent.GOAL_REJECTED)
            for e in record.events
        ),
        'an answer to the goal',
    )
    graph.wait(lambda: record.reports, 'the report')
    graph.wait(lambda: any(action.adapted for action in record.actions), 'an expert action')


@pytest.mark.slow
@pytest.mark.parametrize('node', [node for node in NODES if node != 'robot_bridge_node'])
def test_node_starts_without_arguments_on_the_committed_assets(
    graph: Graph, start_process: Callable[..., NodeProcess], node: str
) -> None:
    assert assets_dir().is_dir()
    process = start_process(node)
    wait_for_node(graph, node)
    if node == 'policy_node':
        graph.wait(lambda: graph.node.count_publishers('action'), 'its publishers', timeout_s=60)
    process.check()
    assert process.stop() == 0
    log = process.log.read_text()
    assert 'ERROR' not in log
    assert 'FATAL' not in log
