"""Real processes under random kills, bad messages, clock jumps and replaced files.

CI runs it for 30 s; `METAGCTTT_CHAOS_S=300` for 5 minutes, `METAGCTTT_CHAOS_SEED` varies it.
"""

from collections import Counter
from collections.abc import Callable
import os
from pathlib import Path
import random
import shutil
import time

from geometry_msgs.msg import PoseStamped
from metagcttt.commander import NoAnswerError, RobotCommander, SentGoal
from metagcttt.converters import to_time
from metagcttt_interfaces.msg import ActionCommand, AdaptationReport, EpisodeEvent, MazeState
from metagcttt_tools.benchmarks.restarts import drive
from metagcttt_tools.graph.process import NodeProcess
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock

from tests.ros.graph import ANY, EVERY, goal_pose, Graph, Record, RELIABLE

pytestmark = [pytest.mark.slow, pytest.mark.mujoco, pytest.mark.timeout(1200)]

SECONDS = float(os.environ.get('METAGCTTT_CHAOS_S', '30'))
SEED = int(os.environ.get('METAGCTTT_CHAOS_SEED', '0'))
PATIENCE_S = 60.0
HUGE = 2**32 - 1


class Chaos:
    """A robot of three processes, a program that uses it, and faults."""

    def __init__(self, graph: Graph, start: Callable[..., NodeProcess], files: dict) -> None:
        self.graph = graph
        self.rng = random.Random(SEED)
        self.files = files
        self._start = start
        dataset, clock = {'dataset': files['dataset']}, {'use_sim_time': True}
        self._parameters = {
            'sim_bridge_node': {'speed_factor': 5.0},
            'goal_node': {**dataset, **clock},
            'policy_node': {**files, **clock, 'adapt_steps': 5, 'adapt_batch_size': 32},
        }
        self.record = Record(graph, ANY)
        self.commander = RobotCommander(context=graph.context, executor=graph._executor)
        self.nodes = {name: start(name, **given) for name, given in self._parameters.items()}
        self.publishers = {
            topic: graph.node.create_publisher(kind, topic, profile)
            for topic, kind, profile in (
                ('state', MazeState, RELIABLE),
                ('action', ActionCommand, RELIABLE),
                ('episode', EpisodeEvent, EVERY),
                ('adaptation', AdaptationReport, EVERY),
                ('goal_pose', PoseStamped, RELIABLE),
                ('/clock', Clock, RELIABLE),
            )
        }
        self.counts: Counter[str] = Counter()
        self.unanswered: list[SentGoal] = []

    def kill(self) -> None:
        name = self.rng.choice(list(self.nodes))
        self.nodes[name].kill()
        self.nodes[name] = self._start(name, **self._parameters[name])

    def bad_message(self) -> None:
        number = self.rng.choice([0, 1, HUGE])
        values = self.rng.choice([[], [float('nan')] * 2, [1e300, 0.0], [0.0] * 10**5])
        topic, message = self.rng.choice(
            [
                ('state', MazeState(episode_id=number, step=HUGE, observation=values)),
                ('action', ActionCommand(episode_id=number, values=values, instance=7)),
                ('episode', EpisodeEvent(kind=200, episode_id=number, goal=values)),
                ('adaptation', AdaptationReport(segment_starts=[0] * 10**4)),
                ('goal_pose', goal_pose(float('inf'), 1e300)),
            ]
        )
        self.publishers[topic].publish(message)

    def clock_jump(self) -> None:
        seconds = self.rng.choice([0, 1, 10**6, 2 * 10**9])
        self.publishers['/clock'].publish(Clock(clock=to_time(seconds * 10**9)))

    def replace_file(self) -> None:
        path = Path(self.files['dataset'])
        copy = path.with_suffix('.new')
        shutil.copy(path, copy)
        os.replace(copy, path)

    def use(self) -> None:
        try:
            if self.rng.random() < 0.5:
                self.commander.set_task(1, timeout_s=2.0)
            goal = self.rng.choice([(20.0, 20.0), (0.0, 4.0), (8.0, 0.0)])
            sent = self.commander.send(goal, max_steps=200, timeout_s=2.0)
        except NoAnswerError:
            self.counts['no answer, and said so'] += 1
        else:
            self.unanswered.append(sent)

    def end_of(self, sent: SentGoal) -> str:
        try:
            return 'reached' if sent.result(PATIENCE_S).success else 'ended'
        except NoAnswerError:
            return 'lost, and said so'


@pytest.fixture
def chaos(graph: Graph, start_process, tmp_path, dataset_file, checkpoint_folder):
    copy = shutil.copy(dataset_file, tmp_path / 'walks.npz')
    files = {'dataset': str(copy), 'checkpoint': str(checkpoint_folder)}
    chaos = Chaos(graph, start_process, files)
    yield chaos
    chaos.commander.destroy_node()


def test_robot_survives_chaos(chaos: Chaos) -> None:
    drive(chaos.commander, PATIENCE_S)
    faults = (chaos.kill, chaos.bad_message, chaos.clock_jump, chaos.replace_file)
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        fault = chaos.rng.choices(faults, weights=(1, 6, 3, 1))[0]
        fault()
        chaos.counts[fault.__name__] += 1
        chaos.use()
        chaos.graph.wait_for(chaos.rng.uniform(0.0, 0.5))
    for sent in chaos.unanswered:
        chaos.counts[chaos.end_of(sent)] += 1
    for process in chaos.nodes.values():
        process.check()
    drive(chaos.commander, PATIENCE_S)
    assert chaos.commander.enable(True, timeout_s=PATIENCE_S).success
    assert chaos.commander.reset(timeout_s=PATIENCE_S).success
    print(chaos.counts, len(chaos.record.actions), 'actions')
    queries = {(q.world_id, q.episode_id, q.query_id) for q in chaos.record.queries}
    actions = [action for action in chaos.record.actions if action.instance != 7]
    assert actions
    for action in actions:
        assert np.abs(action.values).max() <= 1.0
        if action.query_id and any(action.values):
            assert (action.world_id, action.episode_id, action.query_id) in queries
