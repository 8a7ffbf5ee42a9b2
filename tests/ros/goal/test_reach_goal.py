import math
from pathlib import Path
import re

from action_msgs.msg import GoalStatus
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent, PolicyStatus
import pytest
from rclpy.action import ActionClient
from tests.ros.goal_rig import ALSO_FREE, FREE, GoalRig
from tests.ros.graph import goal_pose, Graph

Result = ReachGoal.Result


@pytest.fixture
def make_rig(graph: Graph, dataset_file: Path):
    rigs = []

    def make(**parameters) -> GoalRig:
        rigs.append(GoalRig(graph, dataset_file, **parameters))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.commander.destroy_node()


@pytest.fixture
def rig(make_rig) -> GoalRig:
    return make_rig()


def test_goal_is_reached(rig: GoalRig) -> None:
    rig.state(step=7)
    sent = rig.commander.send(FREE)
    assert sent.accepted
    assert not sent.is_done()
    rig.state(x=2.0, step=8)
    rig.state(x=3.9, step=9)
    result = sent.result()
    assert (result.success, result.steps, result.error_code) == (True, 2, Result.NONE)
    assert result.seconds > 0
    assert result.error_msg == ''
    rig.graph.wait(lambda: len(rig.record.queries) == 2, 'the end of the query')
    assert [query.active for query in rig.record.queries] == [True, False]


def test_full_goal_observation_is_taken_as_it_is(rig: GoalRig) -> None:
    rig.state()
    request = ReachGoal.Goal(goal=[4.25, 0.5], request_id='mine')
    assert rig.commander.send_request(request).accepted
    query = rig.graph.wait(lambda: rig.record.queries and rig.record.queries[0], 'the query')
    assert list(query.goal) == [4.25, 0.5]
    accepted = rig.graph.wait(lambda: rig.record.of_kind(EpisodeEvent.GOAL_ACCEPTED), 'the event')
    assert accepted[0].request_id == 'mine'


def test_feedback_has_phase_distance_and_gradient_steps(rig: GoalRig) -> None:
    rig.state(step=3)
    sent = rig.commander.send(FREE)
    rig.state(x=1.0, step=4)
    rig.graph.wait(lambda: sent.feedback and sent.feedback.steps, 'feedback on the second state')
    assert (sent.feedback.phase, sent.feedback.distance_m) == (ReachGoal.Feedback.WAITING, 3.0)
    assert sent.feedback.steps == 1
    rig.policy(query_id=1, phase=PolicyStatus.ADAPTING, steps_done=4, steps=10)
    rig.graph.wait(lambda: sent.feedback.phase == ReachGoal.Feedback.ADAPTING, 'the phase')
    assert (sent.feedback.adapt_steps_done, sent.feedback.adapt_steps) == (4, 10)
    rig.policy(query_id=1, phase=PolicyStatus.ACTING, steps_done=10, steps=10, adapted=True)
    rig.graph.wait(lambda: sent.feedback.phase == ReachGoal.Feedback.DRIVING, 'the phase')
    assert sent.feedback.adapted


# --- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('request_', 'code', 'reason'),
    [
        ({'pose': goal_pose(*FREE, 'odom')}, Result.WRONG_FRAME, "in frame 'odom'"),
        ({'pose': goal_pose(float('nan'), 0.0)}, Result.NOT_FINITE, 'is not finite'),
        ({'pose': goal_pose(100.0, 0.0)}, Result.OUTSIDE_MAZE, 'outside the maze'),
        ({'pose': goal_pose(8.0, 0.0)}, Result.IN_WALL, 'in a wall, cell (1, 3)'),
        ({'goal': [1.0, 2.0, 3.0]}, Result.WRONG_SIZE, 'has 3 values, 2 are needed'),
        ({'goal': [4.0, float('inf')]}, Result.NOT_FINITE, 'the goal is not finite'),
    ],
)
def test_goal_is_refused_with_code_and_reason(
    rig: GoalRig, request_: dict, code: int, reason: str
) -> None:
    rig.state()
    sent = rig.commander.send_request(ReachGoal.Goal(request_id='x', **request_))
    assert not sent.accepted
    assert not sent.cancel()
    assert rig.error(sent)[0] == code
    assert reason in rig.error(sent)[1]
    assert rig.record.queries == []


def test_plain_action_client_learns_why_a_goal_is_rejected(rig: GoalRig) -> None:
    """As `ros2 action send_goal` does, which shows nothing but the result."""
    rig.state()
    assert rig.commander.send(FREE).accepted
    client = ActionClient(rig.graph.node, ReachGoal, 'reach_goal')
    rig.graph.wait(client.server_is_ready, 'the action')
    sent = client.send_goal_async(ReachGoal.Goal(pose=goal_pose(8.0, 0.0)))
    rig.graph.wait(sent.done, 'the answer')
    answer = sent.result().get_result_async()
    rig.graph.wait(answer.done, 'the result')
    result = answer.result().result
    assert answer.result().status == GoalStatus.STATUS_ABORTED
    assert (result.success, result.error_code) == (False, Result.IN_WALL)
    assert 'in a wall, cell (1, 3)' in result.error_msg
    assert rig.node._tracker.goal.xy == FREE
    client.destroy()


def test_goal_before_the_first_state_is_refused(rig: GoalRig) -> None:
    assert rig.error(rig.commander.send(FREE))[0] == Result.NO_STATE


def test_goal_after_the_episode_is_refused(rig: GoalRig) -> None:
    rig.state(truncated=True)
    assert rig.error(rig.commander.send(FREE))[0] == Result.EPISODE_OVER


# --- endings ------------------------------------------------------------------------------------


def test_newer_action_goal_preempts(rig: GoalRig) -> None:
    rig.state()
    first = rig.commander.send(FREE)
    second = rig.commander.send(ALSO_FREE)
    assert rig.error(first) == (Result.PREEMPTED, 'goal 2 took its place')
    rig.state(x=4.0, step=1)
    rig.state(y=4.0, step=2)
    assert second.result().success
    [ended] = rig.graph.wait(lambda: rig.record.of_kind(EpisodeEvent.ENDED), 'the event')
    assert (ended.query_id, ended.error_code) == (1, Result.PREEMPTED)


def test_goal_pose_preempts(rig: GoalRig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    rig.graph.publish('goal_pose', goal_pose(*ALSO_FREE))
    assert rig.error(sent)[0] == Result.PREEMPTED


def test_refused_goal_leaves_the_one_under_way(rig: GoalRig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    assert not rig.commander.send((8.0, 0.0)).accepted
    rig.state(x=4.0, step=1)
    assert sent.result().success


def test_canceled_goal_stops_the_policy(rig: GoalRig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    assert sent.cancel()
    assert rig.error(sent) == (Result.CANCELED, 'canceled')
    stop = rig.graph.wait(lambda: len(rig.record.queries) == 2 and rig.record.queries[1], 'stop')
    assert (stop.query_id, stop.active) == (1, False)
    assert not sent.cancel()


def test_steps_of_the_goal_run_out(rig: GoalRig) -> None:
    rig.state()
    sent = rig.commander.send(FREE, max_steps=2)
    for step in (1, 2):
        rig.state(step=step)
    code, message = rig.error(sent)
    assert (code, message) == (Result.TIMED_OUT, 'not reached in 2 steps, 4.00 m from the goal')
    assert sent.result().steps == 2


def test_episode_ends_under_way(rig: GoalRig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    rig.state(step=1, truncated=True)
    assert rig.error(sent)[0] == Result.EPISODE_ENDED


@pytest.mark.parametrize('by', ['state', 'started'])
def test_new_episode_ends_the_goal(rig: GoalRig, by: str) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    getattr(rig, by)(episode_id=2)
    assert rig.error(sent) == (Result.NEW_EPISODE, 'episode 2 began')


def test_goal_sent_right_after_a_reset_belongs_to_the_new_episode(rig: GoalRig) -> None:
    rig.state(step=9)
    rig.started(2)
    rig.graph.wait(lambda: rig.record.of_kind(EpisodeEvent.STARTED), 'the event')
    sent = rig.commander.send(FREE)
    rig.state(episode_id=2)
    rig.state(x=4.0, step=1, episode_id=2)
    assert sent.result().steps == 1
    assert rig.graph.wait(lambda: rig.record.queries, 'the query')[0].episode_id == 2


def test_goal_waits_for_its_episode_and_refuses_one_that_is_over(rig: GoalRig) -> None:
    rig.state(step=9, episode_id=2, terminated=True)
    old = ReachGoal.Goal(pose=goal_pose(*FREE), episode_id=1, request_id='old')
    assert rig.error(rig.commander.send_request(old)) == (
        Result.EPISODE_OVER,
        'episode 1 is over, 2 is the newest',
    )
    new = ReachGoal.Goal(pose=goal_pose(*FREE), episode_id=3, request_id='new')
    sent = rig.commander.send_request(new)
    rig.graph.wait(lambda: sent.feedback, 'feedback before the first state of the episode')
    assert (math.isnan(sent.feedback.distance_m), sent.feedback.steps) == (True, 0)
    rig.state(x=4.0, step=10, episode_id=2)
    rig.state(x=4.0, episode_id=3)
    assert sent.result().success


def test_episode_that_never_comes_ends_the_goal(make_rig) -> None:
    rig = make_rig(state_timeout_s=0.3)
    rig.state()
    never = ReachGoal.Goal(pose=goal_pose(*FREE), episode_id=99, request_id='never')
    code, message = rig.error(rig.commander.send_request(never))
    assert (code, 'no state of episode 99' in message) == (Result.STATE_LOST, True)


def test_silent_simulator_ends_the_goal_in_realtime(make_rig) -> None:
    rig = make_rig(stepping='realtime', state_timeout_s=0.3)
    rig.state()
    code, message = rig.error(rig.commander.send(FREE))
    assert code == Result.STATE_LOST
    assert 'no state of episode 1 for 0.' in message


def test_vanished_simulator_ends_the_goal_in_lockstep(make_rig) -> None:
    rig = make_rig(state_timeout_s=0.3)
    rig.state()
    sent = rig.commander.send(FREE)
    rig.graph.node.destroy_publisher(rig._states)
    assert rig.error(sent)[0] == Result.STATE_LOST


def test_policy_that_is_gone_ends_the_goal_in_lockstep(make_rig) -> None:
    rig = make_rig(partner_timeout_s=0.3)
    rig.state()
    code, message = rig.error(rig.commander.send(FREE))
    assert (code, 'no step and no status of the policy' in message) == (Result.POLICY_LOST, True)


def test_goal_after_one_that_waited_in_vain_is_for_the_running_episode(make_rig) -> None:
    rig = make_rig(state_timeout_s=0.3)
    rig.state()
    never = ReachGoal.Goal(pose=goal_pose(*FREE), episode_id=1000, request_id='never')
    assert rig.error(rig.commander.send_request(never))[0] == Result.STATE_LOST
    sent = rig.commander.send(FREE)
    rig.state(*FREE, step=1)
    assert sent.result().success


def test_restarted_simulator_ends_the_goal_although_it_counts_alike(rig: GoalRig) -> None:
    rig.state(step=3, world_id=10)
    sent = rig.commander.send(FREE)
    rig.state(*FREE, step=4, world_id=11)
    code, message = rig.error(sent)
    assert (code, 'started again' in message) == (Result.NEW_EPISODE, True)


def test_goal_node_that_goes_down_ends_the_goal(rig: GoalRig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    rig.node.end_service()
    assert rig.error(sent)[0] == Result.SHUTDOWN


def test_every_error_code_is_provoked_here_or_by_a_robot() -> None:
    here = Path(__file__)
    files = (here, here.parents[1] / 'robot' / 'test_goals.py')
    source = ''.join(file.read_text(encoding='utf-8') for file in files)
    definition = (
        Path(__file__)
        .parents[3]
        .joinpath('ros2_ws/src/metagcttt_interfaces/action/ReachGoal.action')
    )
    named = re.findall(r'^uint16 (\w+)=', definition.read_text(encoding='utf-8'), re.MULTILINE)
    assert len(named) == 19
    assert [
        name for name in named if not re.search(rf'Result\.{name}|RESULT\.{name}', source)
    ] == []
