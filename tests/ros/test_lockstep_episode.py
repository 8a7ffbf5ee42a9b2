from collections.abc import Callable
from pathlib import Path

from metagcttt.goal.node import GoalNode
from metagcttt.policy.node import PolicyNode
from metagcttt.sim.node import SimBridgeNode
from metagcttt_core import (
    FilterConfig,
    load_checkpoint,
    TrajectoryDataset,
    TrajectoryFilter,
    TTTConfig,
)
from metagcttt_core.evaluation.rollout import Episode, run_episode
from metagcttt_interfaces.msg import EpisodeEvent, MazeState
from metagcttt_tools.graph.process import NodeProcess
import numpy as np
import pytest
from sim_bridge import make_simulator
import torch

from tests.ros.graph import EVERY, Graph, Record

pytestmark = pytest.mark.mujoco

# Enough for the untrained policy to move along, so that the episodes are not trivial.
TTT = {'adapt_steps': 60, 'adapt_lr': 0.01, 'adapt_batch_size': 64}
# A goal that a busy machine repeats too late would be taken up anew, with another query.
PATIENT = {'goal_lease_s': 0.0}


def offline_episode(
    checkpoint: Path, dataset: Path, task_id: int, seed: int, horizon: int | None = None
) -> Episode:
    config = TTTConfig(
        steps=TTT['adapt_steps'],
        lr=TTT['adapt_lr'],
        batch_size=TTT['adapt_batch_size'],
        horizon=horizon,
    )
    torch.set_num_threads(1)
    with make_simulator('pointmaze-medium-v0') as simulator:
        return run_episode(
            load_checkpoint(checkpoint),
            simulator,
            task_id,
            seed,
            trajectory_filter=TrajectoryFilter(
                TrajectoryDataset.load(dataset), FilterConfig(variant='gcttt')
            ),
            ttt=config,
        )


def drive(graph: Graph, record: Record, task_id: int, seed: int) -> int:
    """Drive one task to its end and return its episode."""
    episode_id = graph.set_task(task_id, seed).episode_id
    kinds = (EpisodeEvent.REACHED, EpisodeEvent.TIMED_OUT)
    graph.wait(
        lambda: any(e.kind in kinds and e.episode_id == episode_id for e in record.events),
        f'the end of task {task_id}',
        timeout_s=60,
    )
    # The event overtakes states that this process has not taken in yet.
    last = graph.wait(
        lambda: next((s for s in record.states if s.episode_id == episode_id and ended(s)), None),
        'the last state',
    )
    graph.wait(
        lambda: any(
            a.episode_id == episode_id and a.step == last.step - 1 for a in record.actions
        ),
        'the last action',
    )
    graph.wait(lambda: any(r.episode_id == episode_id for r in record.reports), 'the adaptation')
    return episode_id


def ended(state: MazeState) -> bool:
    return state.terminated or state.truncated


def assert_same(record: Record, episode_id: int, expected: Episode) -> None:
    # One that waits for its action for longer is repeated.
    by_step = {state.step: state for state in record.states if state.episode_id == episode_id}
    states = list(by_step.values())
    actions = [action for action in record.actions if action.episode_id == episode_id]
    assert [state.step for state in states] == list(range(expected.steps + 1))
    assert [action.step for action in actions] == list(range(expected.steps))
    np.testing.assert_array_equal([action.values for action in actions], expected.actions)
    np.testing.assert_array_equal([state.observation for state in states], expected.observations)
    assert states[-1].success == expected.success
    reports = [report for report in record.reports if report.episode_id == episode_id]
    assert [report.transitions for report in reports] == [len(s) for s in expected.supports]
    for report, adaptation in zip(reports, expected.adaptations, strict=True):
        np.testing.assert_array_equal(report.train_losses, adaptation.train_losses)


@pytest.mark.parametrize('horizon', [0, 25])
def test_nodes_in_one_process_equal_the_offline_episode(
    graph: Graph, checkpoint_folder: Path, dataset_file: Path, horizon: int
) -> None:
    files = {'dataset': str(dataset_file), 'stepping': 'lockstep'}
    graph.add(SimBridgeNode, stepping='lockstep')
    graph.add(GoalNode, **PATIENT, **files)
    policy = {'checkpoint': str(checkpoint_folder), 'horizon': horizon, 'threads': 1}
    graph.add(PolicyNode, adaptation='hold', **policy, **TTT, **files)
    record = Record(graph, EVERY)
    episode_id = drive(graph, record, task_id=1, seed=3)
    assert_same(
        record,
        episode_id,
        offline_episode(checkpoint_folder, dataset_file, 1, 3, horizon or None),
    )


@pytest.mark.slow
def test_processes_over_dds_equal_the_offline_episode(
    graph: Graph,
    checkpoint_folder: Path,
    dataset_file: Path,
    start_process: Callable[..., NodeProcess],
) -> None:
    files = {'dataset': dataset_file, 'stepping': 'lockstep'}
    policy = {'checkpoint': checkpoint_folder, 'adaptation': 'hold', 'threads': 1, **TTT}
    start_process('policy_node', **policy, **files)
    start_process('goal_node', **PATIENT, **files)
    start_process('sim_bridge_node', stepping='lockstep')
    record = Record(graph, EVERY)
    graph.wait_for_publishers()
    # The state of the first episode is not answered: it has no goal.
    graph.wait(lambda: record.states, 'the first state')
    graph.wait(lambda: graph.node.count_subscribers('goal') == 2, 'the policy')
    drive(graph, record, task_id=2, seed=0)  # after it the policy has matched this process, too
    for task_id, seed in ((1, 3), (4, 8)):
        episode_id = drive(graph, record, task_id, seed)
        expected = offline_episode(checkpoint_folder, dataset_file, task_id, seed)
        assert_same(record, episode_id, expected)
