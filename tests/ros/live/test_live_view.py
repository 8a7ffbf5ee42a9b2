"""The live view as its users have it: processes, a browser and clicks."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
import signal
import socket
import subprocess
import sys
from typing import Any

from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent
from metagcttt_tools.graph.process import NodeProcess
from metagcttt_tools.recordings.mcap import read_messages
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python
from sim_bridge import maze_map
from tests.ros.graph import Graph, Record
from tests.ros.live.browser import Browser, needs_chromium

MAZE = maze_map('pointmaze-medium-v0')
STATES = ('metagcttt_interfaces/msg/MazeState',)
TELEPHONE = (390, 844)
FAR, NEAR = (20.0, 20.0), (4.0, 0.0)

pytestmark = [pytest.mark.slow, pytest.mark.mujoco, pytest.mark.timeout(600), needs_chromium]


@pytest.fixture
def nodes(start_process: Callable[..., NodeProcess]) -> dict[str, NodeProcess]:
    """The three nodes in an episode without end, as a browser may take its time."""
    parameters = {'sim_bridge_node': {}, 'goal_node': {'max_steps': 100000}, 'policy_node': {}}
    return {name: start_process(name, **given) for name, given in parameters.items()}


@contextmanager
def viewing(*arguments: str) -> Iterator[subprocess.Popen]:
    """`metagcttt view`; the attribute `url` is where it listens."""
    command = [sys.executable, '-m', 'metagcttt_tools', 'view', *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        lines = iter(process.stdout.readline, '')
        line = next(line for line in lines if line.startswith(('live view', 'replay of')))
        process.url = line.split()[-1]
        yield process
        process.terminate()
        assert process.wait(30) == 0


@pytest.fixture
def view(ros_domain: int, tmp_path: Path) -> Iterator[subprocess.Popen]:
    with viewing('--out', str(tmp_path / 'out')) as process:
        yield process


@pytest.fixture
def record(graph: Graph, nodes: dict[str, NodeProcess]) -> Record:
    return Record(graph)


def end_of_goal(graph: Graph, record: Record, number: int) -> EpisodeEvent:
    """How the goal of this number ended."""
    ends = (EpisodeEvent.REACHED, EpisodeEvent.TIMED_OUT, EpisodeEvent.ENDED)
    return graph.wait(
        lambda: next((e for e in record.events if e.query_id == number and e.kind in ends), None),
        f'the end of goal {number}',
        timeout_s=200.0,
    )


def goal(graph: Graph, record: Record, number: int):
    return graph.wait(
        lambda: next((q for q in record.queries if q.query_id == number and q.active), None),
        f'goal {number}',
    )


def test_click_on_the_floor_makes_the_robot_reach_it(
    graph: Graph, record: Record, view: subprocess.Popen
) -> None:
    with Browser(view.url, MAZE) as browser:
        browser.wait_for_text('stepping')
        browser.wait_for_text('policy_node')
        browser.click_floor(FAR)
        clicked = goal(graph, record, 1).position
        assert (clicked.x, clicked.y) == pytest.approx(FAR, abs=0.2)
        assert end_of_goal(graph, record, 1).kind == EpisodeEvent.REACHED
        browser.wait_for_text('goal 1 reached')

        browser.click_floor(NEAR)
        goal(graph, record, 2)
        browser.click_button('Cancel goal')
        assert end_of_goal(graph, record, 2).error_code == ReachGoal.Result.CANCELED

        browser.click_floor((-4.0, -4.0))  # a wall
        browser.wait_for_text('goal rejected: ')


def test_controls_change_the_graph(graph: Graph, record: Record, view, tmp_path: Path) -> None:
    def parameter(name: str) -> Any:
        request = GetParameters.Request(names=[name])
        answer = graph.call(GetParameters, 'policy_node/get_parameters', request)
        return parameter_value_to_python(answer.values[0])

    with Browser(view.url, MAZE) as browser:
        browser.wait_for_text('stepping')
        browser.wait_for_text('policy_node')
        assert parameter('adapt_steps') == 10
        browser.click_checkbox('Test-time training')
        graph.wait(lambda: parameter('adapt_steps') == 0, 'no adaptation')
        browser.click_checkbox('Test-time training')
        graph.wait(lambda: parameter('adapt_steps') == 10, 'the K of before')
        browser.type_number('K (gradient steps)', '25')
        graph.wait(lambda: parameter('adapt_steps') == 25, 'the K that was typed')

        browser.choose('Policy', 'base')
        graph.wait(lambda: Path(parameter('checkpoint')).name == 'base', 'another policy')

        browser.click_checkbox('Record')
        browser.wait_for_text('recording to')
        path = graph.wait(lambda: list(tmp_path.glob('out/*.mcap')), 'a recording')[0]
        graph.wait(lambda: path.stat().st_size, 'something in it')
        graph.wait(lambda: read_messages(path, STATES).messages, 'a state in it')
        browser.click_checkbox('Record')
        browser.wait(lambda: 'messages in' in path.with_suffix('.log').read_text(), 'its end')
    assert read_messages(path, STATES).complete
    with viewing('--replay', str(path)) as replay, Browser(replay.url, MAZE) as browser:
        browser.wait_for_text('Time (s)')
        browser.wait_for_text('policy_node')


def test_lost_browser_and_lost_nodes_harm_nothing(
    graph: Graph, record: Record, view, nodes: dict[str, NodeProcess], start_process
) -> None:
    with Browser(view.url, MAZE) as browser:
        browser.wait_for_text('stepping')
        browser.wait_for_text('policy_node')
        browser.click_floor(FAR)
        goal(graph, record, 1)
    assert end_of_goal(graph, record, 1).kind == EpisodeEvent.REACHED
    with Browser(view.url, MAZE, TELEPHONE) as browser:
        browser.wait_for_text('goal 1 reached')
        nodes['policy_node'].kill()
        browser.wait_for_text('policy_node: silent')
        start_process('policy_node')
        browser.wait(lambda: 'silent' not in browser.text(), 'the new policy')
        browser.click_floor(NEAR)
        clicked = goal(graph, record, 2).position
        assert (clicked.x, clicked.y) == pytest.approx(NEAR, abs=0.3)
        graph.wait(lambda: [r for r in record.reports if r.query_id == 2], 'an adaptation')
    assert view.poll() is None


def test_only_this_machine_reaches_it(view) -> None:
    port = int(view.url.rpartition(':')[2])
    socket.create_connection(('127.0.0.1', port)).close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(('127.0.0.2', port))  # also this machine
    view.send_signal(signal.SIGINT)
    assert view.wait(30) == 0
