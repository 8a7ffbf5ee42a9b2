from collections.abc import Callable
from pathlib import Path
import signal

from metagcttt import commander as commander_module
from metagcttt.commander import GoalLostError, NoAnswerError, RobotCommander
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import GoalQuery
from metagcttt_tools.graph.process import NodeProcess
import pytest

from tests.ros.goal_rig import FREE, GoalRig
from tests.ros.graph import Graph

Result = ReachGoal.Result


@pytest.fixture
def rig(graph: Graph, dataset_file: Path):
    rig = GoalRig(graph, dataset_file)
    yield rig
    rig.commander.destroy_node()


def test_blocking_call_cancels_what_takes_too_long(rig: GoalRig) -> None:
    rig.state()
    with pytest.raises(NoAnswerError, match=r'no answer within 0\.5 s: the goal'):
        rig.commander.reach(FREE, timeout_s=0.5)
    rig.graph.wait(lambda: len(rig.record.queries) == 2, 'the stop')


def test_absent_robot_is_an_error(graph: Graph) -> None:
    commander = RobotCommander(context=graph.context)
    with pytest.raises(NoAnswerError, match='action reach_goal'):
        commander.reach(FREE, timeout_s=0.2)
    with pytest.raises(NoAnswerError, match=r'service .*set_task'):
        commander.set_task(1, timeout_s=0.2)
    commander.destroy_node()


@pytest.mark.slow
def test_processes_drive_to_a_goal_and_end_it_when_they_go_down(
    graph: Graph,
    start_process: Callable[..., NodeProcess],
    dataset_file: Path,
    checkpoint_folder: Path,
) -> None:
    start_process('sim_bridge_node', stepping='lockstep')
    goals = start_process('goal_node', dataset=dataset_file, stepping='lockstep')
    start_process(
        'policy_node',
        dataset=dataset_file,
        checkpoint=checkpoint_folder,
        stepping='lockstep',
        adaptation='hold',
        adapt_steps=5,
    )
    commander = RobotCommander(context=graph.context, executor=graph._executor)
    queries = graph.collect(GoalQuery, 'goal')
    task = commander.set_task(1, timeout_s=60)
    goal = (task.goal_position.x, task.goal_position.y)
    graph.wait(commander._reach_goal.server_is_ready, 'the goal node')
    result = commander.reach(goal, max_steps=20)
    assert (result.success, result.error_code) == (False, Result.TIMED_OUT)
    assert result.steps == 20
    commander.set_task(1, timeout_s=60)
    sent = commander.send(goal, timeout_s=60)
    graph.wait(lambda: sent.feedback and sent.feedback.adapted, 'the expert')
    assert goals.stop(signal_number=signal.SIGTERM) == 0
    assert sent.result(60).error_code == Result.SHUTDOWN
    assert not queries[-1].active
    commander.destroy_node()


def test_goal_of_a_node_that_vanished_is_an_error_in_time(
    rig: GoalRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commander_module, 'SILENT_S', 0.5)
    rig.state()
    sent = rig.commander.send(FREE)
    rig.graph.wait(lambda: sent.feedback, 'feedback')
    rig.graph.wait_for(1.0)  # as long as its node is there, nothing is lost
    assert not sent.is_done()
    rig.graph._executor.remove_node(rig.node)  # as a process that hangs or was killed
    with pytest.raises(GoalLostError, match='the goal node is gone, and the goal with it'):
        sent.result(timeout_s=30)
    rig.graph._executor.add_node(rig.node)


def test_goal_that_nobody_asked_about_for_long_is_not_lost(
    rig: GoalRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    rig.graph.wait(lambda: sent.feedback, 'feedback')
    assert not sent.is_done()
    later = commander_module.time.monotonic() + 60
    monkeypatch.setattr(commander_module.time, 'monotonic', lambda: later)
    assert not sent.is_done()
