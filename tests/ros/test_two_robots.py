"""What two_robots.launch.py starts, as real processes over DDS."""

from collections.abc import Callable
from itertools import product
from pathlib import Path
from types import SimpleNamespace

from metagcttt_interfaces.msg import ActionCommand, AdaptationReport, MazeState
from metagcttt_interfaces.srv import SetTask
from metagcttt_tools.graph.process import NodeProcess
from metagcttt_tools.recordings.trajectories import read_recordings
import numpy as np
import pytest

from tests.ros.graph import EVERY, Graph, RELIABLE
from tests.ros.test_lockstep_episode import assert_same, offline_episode, TTT

ROBOTS = ('/robot1', '/robot2')

pytestmark = [pytest.mark.mujoco, pytest.mark.slow]


def start_robot(start_process, robot: str, checkpoint: Path, dataset: Path) -> None:
    files = {'dataset': dataset, 'stepping': 'lockstep'}
    policy = {'checkpoint': checkpoint, 'adaptation': 'hold', 'threads': 1, **TTT}
    start_process('sim_bridge_node', robot, stepping='lockstep')
    start_process('goal_node', robot, **files)
    start_process('policy_node', robot, **policy, **files)


def listen(graph: Graph, robot: str) -> SimpleNamespace:
    return SimpleNamespace(
        states=graph.collect(MazeState, f'{robot}/state', EVERY),
        actions=graph.collect(ActionCommand, f'{robot}/action', RELIABLE),
        reports=graph.collect(AdaptationReport, f'{robot}/adaptation', EVERY),
    )


def test_two_robots_in_one_graph_do_not_disturb_each_other(
    graph: Graph,
    tmp_path: Path,
    checkpoint_folder: Path,
    dataset_file: Path,
    start_process: Callable[..., NodeProcess],
) -> None:
    output = tmp_path / 'both.mcap'
    recorder = start_process('recorder_node', output=output)
    for robot in ROBOTS:
        start_robot(start_process, robot, checkpoint_folder, dataset_file)
    records = {robot: listen(graph, robot) for robot in ROBOTS}
    graph.wait_for_publishers(timeout_s=90)
    # The robot's own nodes, the recorder and, but for goals, this process.
    needed = {'goal': 1 + 1, 'state': 2 + 1 + 1, 'action': 1 + 1 + 1}
    for robot, (topic, count) in product(ROBOTS, needed.items()):
        name = f'{robot}/{topic}'
        graph.wait(
            lambda name=name, count=count: graph.node.count_subscribers(name) >= count,
            f'who listens to {name}',
            timeout_s=90,
        )
    tasks = {'/robot1': (1, 3), '/robot2': (4, 8)}
    for robot, (task_id, seed) in tasks.items():
        request = SetTask.Request(task_id=task_id, seed=seed, send_goal=True)
        response = graph.call(SetTask, f'{robot}/set_task', request)
        assert (response.success, response.episode_id) == (True, 2)
    expected = {
        robot: offline_episode(checkpoint_folder, dataset_file, task_id, seed)
        for robot, (task_id, seed) in tasks.items()
    }
    for robot, record in records.items():
        steps = expected[robot].steps
        graph.wait(
            lambda record=record, steps=steps: (
                record.states[-1].step >= steps
                and record.actions[-1].step >= steps - 1
                and record.reports
            ),
            f'the end of the episode of {robot}',
            timeout_s=90,
        )
        assert_same(record, 2, expected[robot])
    assert graph.node.count_publishers('/clock') == 0
    assert graph.node.count_publishers('/robot1/clock') == 1

    # On a busy machine DDS loses packets and sends them again, at the latest after three seconds.
    graph.wait_for(4.0)
    assert recorder.stop() == 0
    dataset, summary = read_recordings([output], refuse_gaps=True)
    assert summary.trajectories == 2
    for start, end, robot in zip(
        dataset.episode_starts, dataset.episode_ends, ROBOTS, strict=True
    ):
        np.testing.assert_array_equal(
            dataset.observations[start : end + 1],
            expected[robot].observations.astype(np.float32),
        )
