"""Every setting of what drives robots through the ROS graph, by what the nodes are told."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

from metagcttt import commander
import metagcttt_core
from metagcttt_core.config import assets_dir
from metagcttt_interfaces.srv import Adapt
from metagcttt_tools import demo, demo_film, evaluate_robot
from metagcttt_tools.benchmarks import adapter, restarts, ros, state_source
from metagcttt_tools.benchmarks.fleet_robot import Outcome
from metagcttt_tools.common import demo_report
from metagcttt_tools.graph import drive
from metagcttt_tools.graph import process as nodes
from metagcttt_tools.graph.robot import RobotOutcome
from metagcttt_tools.live import replay
from metagcttt_tools.live import view as live
import numpy as np
import pytest
import rclpy
from rclpy.serialization import deserialize_message
from tests.tools.settings.walk import FILTER, INNER_LOOP, Proof, Seen, Walk, walks_through

pytestmark = pytest.mark.ros


def watch_graph(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def note(arms, drives, **others):
        seen.append((arms, drives, others))
        report = mock.Mock(filter_ms=1.0, adapt_ms=1.0)
        outcome = mock.Mock(success=True, report=report)
        return {arm: [outcome] * len(drives) for arm in arms}

    patch.setattr(drive, 'drive_arms', note)
    patch.setattr(demo, 'report', lambda *_: None)
    patch.setattr(demo_report, 'packed_assets', lambda name, preset: assets_dir() / name)
    patch.setattr(demo_film, 'film', lambda *given: seen.append(given))
    patch.setattr(demo, 'drive_by_hand', lambda settings: seen.append('by hand'))
    watch_robot(patch, seen)


def watch_robot(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    def note(graph, arms, drives, client_type, logs):
        seen.append((list(graph), arms, drives, client_type, logs))
        report = SimpleNamespace(filter_ms=1.0, adapt_ms=1.0, transitions=1)
        outcome = RobotOutcome(True, seconds=1.0, steps=1, missed=0, path=[], report=report)
        return {arm: [outcome] * len(drives) for arm in arms}

    patch.setattr(drive, 'drive_policies', note)
    patch.setattr(evaluate_robot, 'unchanged', lambda *_: nullcontext({'fingerprints': {}}))
    patch.setattr(demo_report, 'draw', lambda *_: None)


NO_PARAMETER = 'policy_node has no such parameter'
WITHOUT_PARAMETER = {
    **{f'ttt.{name}': INNER_LOOP[name] for name in ('optimizer', 'fix_actor_goal', 'ratio')},
    **{f'filter.{name}': FILTER[name] for name in ('top_k', 'position_dims', 'scale', 'slack')},
    'ttt.max_test': 1,
    'filter.min_steps': 60,
    'filter.seed': 5,
}
EVALUATE_ROS = Walk(
    'evaluate-ros',
    {
        'dataset': '@walks.npz',
        'checkpoints': ['@gcbc'],
        'budgets': [2],
        'episodes': 1,
        'seeds': [0],
    },
    {
        'checkpoints': ['@other'],
        'dataset': '@half.npz',
        'budgets': [1],
        'episodes': 2,
        'seeds': [5],
        'standing': Proof(True, refused='only humanoids have a standing start'),
        'timeout_s': 7.0,
        'out': 'elsewhere/evaluation.json',
        'ttt.lr': 0.1,
        'ttt.batch_size': 9,
        'ttt.early_stopping': True,
        'ttt.test_fraction': 0.6,
        'ttt.guard': 'loss',
        'ttt.actor_only': True,
        'ttt.horizon': 2,
        'ttt.optimizer_state': 'pretrained',
        'ttt.engine': 'eager',
        'ttt.precision': 'bfloat16',
        'filter.variant': 'gcttt',
        'filter.epsilon': 9.0,
        'filter.top_percent': 50.0,
        **{
            name: Proof(getattr(proof, 'value', proof), refused=NO_PARAMETER)
            for name, proof in WITHOUT_PARAMETER.items()
        },
    },
    watch_graph,
)
DEMO = Walk(
    'demo',
    {},
    {
        'robot': 'diffbot',
        'out': 'elsewhere',
        'steps': 3,
        'seed': 1,
        'timeout_s': 7.0,
        'film': Proof('film.gif', {'robot': 'ant'}),
        'view': True,
    },
    watch_graph,
)
CONTRACTS = Path(__file__).parents[3] / 'config' / 'robots'
EVALUATE_ROBOT = Walk(
    'evaluate-robot',
    {
        'contract': str(CONTRACTS / 'diffbot.yaml'),
        'tasks': str(assets_dir() / 'diffbot' / 'tasks.yaml'),
        'checkpoints': ['policy-{seed}'],
    },
    {
        'contract': str(CONTRACTS / 'arm4.yaml'),
        'dataset': 'elsewhere.npz',
        'tasks': '@tasks.yaml',
        'lr': 0.1,
        'batch_size': 7,
        'speed_factor': 2.0,
        'timeout_s': 7.0,
        'checkpoints': ['policy-{seed}', 'other-{seed}'],
        'budgets': [3],
        'seeds': [0, 1],
        'out': 'elsewhere/results.json',
    },
    watch_robot,
)


def watch_view(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    patch.setattr(live, 'show', lambda **settings: seen.append(settings))
    patch.setattr(live, 'show_replay', lambda *given, **settings: seen.append((given, settings)))
    patch.setattr(replay, 'Replay', lambda *files: files)


VIEW = Walk(
    'view',
    {},
    {
        **{'host': '0.0.0.0', 'port': 9000, 'robot': '/robot1', 'out': 'elsewhere'},
        'replay': 'run.mcap',
        'checkpoint': Proof('policy', given={'replay': 'run.mcap'}),
        'dataset': Proof('data.npz', given={'replay': 'run.mcap'}),
    },
    watch_view,
)


def watch_latency(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    """The policy node and the program in the simulator's place are noted, and time flies."""

    class Source:
        seen = mock.Mock(adapted={})

        def __init__(self, observations, rate_hz, check):
            seen.append(('rate', rate_hz))
            self.period_s = 1 / rate_hz

        def wait_until_ready(self, timeout_s):
            seen.append(('wait', timeout_s))

        def configure_policy(self, **parameters):
            seen.append(parameters)

        def send_goal(self, goal, seed):
            seen.append((goal, seed))
            return 1, 0.0

        def play(self, duration_s, every=lambda elapsed_s: None, until=None):
            seen.append(('play', duration_s))
            for elapsed_s in np.linspace(0, duration_s, 5):
                every(elapsed_s)
            answers = mock.Mock(sent={}, adapted={}, reports=[])
            answers.latencies_ms.return_value = np.ones(1)
            return answers

        def destroy_node(self):
            pass

    def process(*given):
        seen.append((given[0], without_folder(given[1]), given[2]))
        return mock.MagicMock()

    def without_folder(parameters):
        return {name: value for name, value in parameters.items() if name != 'checkpoint'}

    patch.setattr(state_source, 'StateSource', Source)
    patch.setattr(nodes, 'NodeProcess', process)
    patch.setattr(metagcttt_core, 'save_checkpoint', lambda agent, path: seen.append(agent))
    patch.setattr(ros, 'watching', lambda *given: seen.append(given) or nullcontext())
    patch.setattr(ros, 'write_report', lambda path, *_: seen.append(path))
    without_graph(patch)


def without_graph(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(drive, 'own_domain', nullcontext)
    for call in ('init', 'try_shutdown'):
        patch.setattr(rclpy, call, lambda: None)


BENCHMARK_ROS = Walk(
    'benchmark ros',
    {'hidden': [4], 'steps': [1], 'repeats': 1},
    {
        'out': 'elsewhere',
        'duration_s': 7.0,
        'idle_s': 7.0,
        'goal_every_s': 100.0,
        'rate_hz': 7.0,
        'agent': 'gciql',
        'hidden': [3],
        'steps': [2],
        'repeats': 2,
        'timeout_s': 7.0,
        'stepping': 'lockstep',
        'audience': 'reader',
        'turns': 2,
        'seed': 1,
    },
    watch_latency,
)


def watch_restarts(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    node = mock.Mock()
    node.stop.return_value = 0
    patch.setattr(restarts.RestartsBenchmark, '_start', lambda *_, **__: node)
    patch.setattr(restarts, 'drive', lambda commander, *given, **_: seen.append(given))
    patch.setattr(restarts, 'write_report', lambda path, *_: seen.append(path))
    patch.setattr(commander, 'RobotCommander', mock.Mock)
    without_graph(patch)


BENCHMARK_RESTARTS = Walk(
    'benchmark restarts',
    {'repeats': 1},
    {'out': 'elsewhere', 'repeats': 2, 'timeout_s': 7.0},
    watch_restarts,
)


def watch_adapter(patch: pytest.MonkeyPatch, seen: Seen) -> None:
    """The processes are noted with what they are told."""

    class Connection:
        def send(self, order):
            seen.append(order)

        def recv(self):
            return [Outcome('expert', 0, 1.0)]

        def close(self):
            pass

    class Processes:
        @staticmethod
        def Pipe():
            return Connection(), Connection()

        @staticmethod
        def Process(target, args, daemon):
            name, requests, timeout_s, _ = args
            # Not their bytes, between which serialization leaves some as they are.
            asked = [str(deserialize_message(each, Adapt.Request)) for each in requests]
            seen.append((name, asked, timeout_s))
            return mock.Mock()

    def process(*given):
        parameters = {name: value for name, value in given[1].items() if name != 'checkpoint'}
        seen.append((given[0], parameters, given[2]))
        return mock.MagicMock()

    patch.setattr(adapter.multiprocessing, 'get_context', lambda _: Processes)
    patch.setattr(nodes, 'NodeProcess', process)
    patch.setattr(adapter, 'write_report', lambda path, *_: seen.append(path))
    without_graph(patch)


BENCHMARK_ADAPTER = Walk(
    'benchmark adapter',
    {'robots': 2, 'hidden': [4], 'steps': 1, 'batch_size': 8},
    {
        'out': 'elsewhere',
        'robots': 3,
        'duration_s': 7.0,
        'goal_every_s': 7.0,
        'rush_every_s': 7.0,
        'workers': 3,
        'rush_queue': 7,
        'agent': 'gciql',
        'hidden': [3],
        'steps': 2,
        'batch_size': 9,
        'timeout_s': 7.0,
        'seed': 1,
    },
    watch_adapter,
)

WALKS = (
    *(EVALUATE_ROS, EVALUATE_ROBOT, DEMO, VIEW),
    *(BENCHMARK_ROS, BENCHMARK_RESTARTS, BENCHMARK_ADAPTER),
)


@walks_through(WALKS)
def test_setting(walk: Walk, name: str, tmp_path: Path, places: Path) -> None:
    walk.check(name, tmp_path, places)
