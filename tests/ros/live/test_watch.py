"""Requests of the live view, to real nodes in this process."""

from pathlib import Path
import shutil

from metagcttt.commander import NoAnswerError
from metagcttt.goal.node import GoalNode
from metagcttt_interfaces.action import ReachGoal
from metagcttt_tools.live import watch as watch_module
from metagcttt_tools.live import words
from metagcttt_tools.live.robots import Robot
from metagcttt_tools.live.watch import RefusedError, Watch
import pytest
from tests.ros.goal_rig import FREE, GoalRig
from tests.ros.graph import Graph
from tests.ros.policy_rig import PolicyRig


@pytest.fixture
def goals(graph: Graph, dataset_file: Path):
    goals = GoalRig(graph, dataset_file)
    yield goals
    goals.commander.destroy_node()


@pytest.fixture
def watch(graph: Graph):
    watch = Watch(context=graph.context, executor=graph._executor)
    yield watch
    watch.destroy_node()


@pytest.fixture
def policy(graph: Graph, checkpoint_folder: Path, dataset_file: Path) -> PolicyRig:
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    return PolicyRig(graph, files)


def test_settings_and_health_are_those_of_the_nodes(
    graph: Graph, dataset_file: Path, watch: Watch, policy: PolicyRig, monkeypatch
) -> None:
    graph.add(GoalNode, dataset=str(dataset_file), goal_tolerance_m=0.25)
    graph.wait(lambda: watch.read_settings() or (watch.policy and watch.robot), 'the settings')
    assert watch.policy['adapt_steps'] == 3
    assert watch.robot == Robot('pointmaze-medium-v0', (0, 1), tolerance_m=0.25)
    graph.wait(lambda: len(watch.health()) == 2, 'the health of both')
    assert watch.health()[1] == ('policy_node', 0, 'no goal')
    monkeypatch.setattr(words, '_SILENT_S', 0.0)
    assert [(level, text) for _, level, text in watch.health()] == 2 * [(2, 'silent')]


def test_goal_of_another_client_is_cancelled(graph: Graph, goals: GoalRig, watch: Watch) -> None:
    goals.state()
    with pytest.raises(RefusedError, match='no goal of the reach_goal action'):
        watch.cancel_goals()
    sent = goals.commander.send(FREE)
    watch.cancel_goals()
    assert goals.error(sent)[0] == ReachGoal.Result.CANCELED
    graph.wait(lambda: watch.news == 'goal 1 ended: canceled', 'the news')


def test_refused_parameter_is_named(watch: Watch, policy: PolicyRig) -> None:
    watch.set_policy(adapt_steps=0)
    assert policy.node.get_parameter('adapt_steps').value == 0
    with pytest.raises(RefusedError, match='read at configuration'):
        watch.set_policy(cache_size=3)


def test_policy_changes_to_another_checkpoint(
    watch: Watch, policy: PolicyRig, checkpoint_folder: Path, tmp_path: Path
) -> None:
    other = tmp_path / 'other'
    shutil.copytree(checkpoint_folder, other)
    watch.change_checkpoint(str(other))
    assert policy.node.get_parameter('checkpoint').value == str(other)
    assert policy.session is not None
    with pytest.raises(RefusedError, match='cannot be configured with'):
        watch.change_checkpoint(str(tmp_path))
    watch.change_checkpoint(str(checkpoint_folder))  # also from there
    assert policy.session is not None


def test_absent_nodes_are_an_error_in_time(watch: Watch, monkeypatch) -> None:
    monkeypatch.setattr(watch_module, '_ANSWER_S', 0.2)
    watch.read_settings()  # of nobody
    with pytest.raises(NoAnswerError):
        watch.cancel_goals()
    with pytest.raises(NoAnswerError):
        watch.set_policy(adapt_steps=1)
