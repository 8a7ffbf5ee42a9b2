"""Every test here runs on a ROS domain of its own, on a small policy and dataset of its own."""

from collections.abc import Callable, Iterator
import os
from pathlib import Path
import threading

# Before any message is imported: wrong types in fields are errors.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'

from domain_coordinator import domain_id
from metagcttt import deployment
from metagcttt_core import make_agent, save_checkpoint, TrajectoryDataset
from metagcttt_tools.graph.process import NodeProcess
import pytest

from tests.ros.graph import Graph
from tests.ros.maze_walks import maze_walks


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if here in item.path.parents:
            item.add_marker(pytest.mark.ros)


class NextDomain:
    """Proposes the domains one after the other, so that no test inherits its forerunner's."""

    def __init__(self) -> None:
        self._last = os.getpid()

    def __call__(self) -> int:
        self._last += 1
        return self._last % 100 + 1


next_domain = NextDomain()


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A domain that no other test or program of this machine uses, for this test's processes."""
    with domain_id(next_domain) as number:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(number))
        monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        yield number


@pytest.fixture
def graph(ros_domain: int) -> Iterator[Graph]:
    """Nodes of this process, spun by the test itself."""
    graph = Graph(ros_domain)
    yield graph
    graph.close()


@pytest.fixture(scope='session')
def dataset_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three noisy walks from the start to the goal of each task of the medium point maze."""
    path = tmp_path_factory.mktemp('dataset') / 'walks.npz'
    walks: TrajectoryDataset = maze_walks('pointmaze-medium-v0')
    walks.save(path)
    return path


@pytest.fixture(scope='session')
def checkpoint_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that was never trained."""
    path = tmp_path_factory.mktemp('checkpoint') / 'policy'
    save_checkpoint(make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(32, 32)), path)
    return path


@pytest.fixture
def start_process(tmp_path: Path, ros_domain: int) -> Iterator[Callable[..., NodeProcess]]:
    """Starts executables in processes of their own; all are gone after the test.

    pytest shows their logs when the test fails.
    """
    started: list[NodeProcess] = []

    def start(
        executable: str,
        namespace: str = '',
        package: str = 'metagcttt',
        **parameters: bool | int | float | str,
    ) -> NodeProcess:
        log = tmp_path / f'{len(started)}-{executable}.log'
        # A robot in a namespace has a time of its own, as in two_robots.launch.py.
        remappings = {'__ns': namespace, '/clock': 'clock'} if namespace else {}
        started.append(
            NodeProcess(executable, parameters, log, remappings=remappings, package=package)
        )
        return started[-1]

    yield start
    for process in started:
        process.stop()
        print(process.describe('was stopped'))


@pytest.fixture
def slow_adaptation(monkeypatch: pytest.MonkeyPatch):
    """Adaptations wait until the test lets them go on, or until they are cancelled."""
    go_on = threading.Event()

    def slow_adapt(*args, should_stop=None, **kwargs):
        while should_stop and not (go_on.wait(0.001) or should_stop()):
            pass
        return adapt(*args, should_stop=should_stop, **kwargs)

    adapt = deployment.adapt
    monkeypatch.setattr(deployment, 'adapt', slow_adapt)
    return go_on
