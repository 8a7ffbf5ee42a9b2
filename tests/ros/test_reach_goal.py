from collections.abc import Callable
from pathlib import Path
import re
import signal

from metagcttt.commander import NoAnswerError, RobotCommander
from metagcttt.goal_node import GoalNode
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent, GoalQuery, MazeState, PolicyStatus
import pytest
from tools.node_process import NodeProcess

from tests.ros.graph import EVERY, goal_pose, Graph, Record

Result = ReachGoal.Result
FREE = (4.0, 0.0)
ALSO_FREE = (0.0, 4.0)


class Rig:
    """A goal node and its client; the test plays the simulator and the policy."""

    def __init__(self, graph: Graph, dataset: Path, **parameters) -> None:
        self.graph = graph
        self.node = graph.add(
            GoalNode, **{'dataset': str(dataset), 'stepping': 'lockstep', **parameters}
        )
        self.record = Record(graph, EVERY)
        self.commander = RobotCommander(context=graph.context, executor=graph._executor)
        self._states = graph.node.create_publisher(MazeState, 'state', EVERY)
        self._events = graph.node.create_publisher(EpisodeEvent, 'episode', EVERY)
        self._policy = graph.node.create_publisher(PolicyStatus, 'policy_status', EVERY)
        graph.wait(
            lambda: (
                self._states.get_subscription_count() == 2
                and self._events.get_subscription_count() == 3
                and self._policy.get_subscription_count() == 1
            ),
            'the goal node',
        )

    def state(self, x: float = 0.0, y: float = 0.0, step: int = 0, episode_id: int = 1, **flags):
        message = MazeState(episode_id=episode_id, step=step, observation=[x, y], **flags)
        message.position.x, message.position.y = x, y
        known = len(self.record.states)
        self._states.publish(message)
        self.graph.wait(lambda: len(self.record.states) > known, 'the state')

    def started(self, episode_id: int) -> None:
        self._events.publish(EpisodeEvent(kind=EpisodeEvent.STARTED, episode_id=episode_id))

    def policy(self, **fields) -> None:
        self._policy.publish(PolicyStatus(**fields))

    def error(self, sent) -> tuple[int, str]:
        result = sent.result(10)
        assert not result.success
        return result.error_code, result.error_msg


@pytest.fixture
def make_rig(graph: Graph, dataset_file: Path):
    rigs = []

    def make(**parameters) -> Rig:
        rigs.append(Rig(graph, dataset_file, **parameters))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.commander.destroy_node()


@pytest.fixture
def rig(make_rig) -> Rig:
    return make_rig()


def test_goal_is_reached(rig: Rig) -> None:
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
    assert [query.active for query in rig.record.queries] == [True, False]


def test_full_goal_observation_is_taken_as_it_is(rig: Rig) -> None:
    rig.state()
    request = ReachGoal.Goal(goal=[4.25, 0.5], request_id='mine')
    assert rig.commander.send_request(request).accepted
    query = rig.graph.wait(lambda: rig.record.queries and rig.record.queries[0], 'the query')
    assert list(query.goal) == [4.25, 0.5]
    accepted = rig.graph.wait(lambda: rig.record.of_kind(EpisodeEvent.GOAL_ACCEPTED), 'the event')
    assert accepted[0].request_id == 'mine'


def test_feedback_has_phase_distance_and_gradient_steps(rig: Rig) -> None:
    rig.state(step=3)
    sent = rig.commander.send(FREE)
    rig.state(x=1.0, step=4)
    first = rig.graph.wait(lambda: sent.feedback, 'feedback')
    assert (first.phase, first.distance_m, first.steps) == (ReachGoal.Feedback.WAITING, 3.0, 1)
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
    rig: Rig, request_: dict, code: int, reason: str
) -> None:
    rig.state()
    sent = rig.commander.send_request(ReachGoal.Goal(request_id='x', **request_))
    assert not sent.accepted
    assert not sent.cancel()
    assert rig.error(sent)[0] == code
    assert reason in rig.error(sent)[1]
    assert rig.record.queries == []


def test_goal_before_the_first_state_is_refused(rig: Rig) -> None:
    assert rig.error(rig.commander.send(FREE))[0] == Result.NO_STATE


def test_goal_after_the_episode_is_refused(rig: Rig) -> None:
    rig.state(truncated=True)
    assert rig.error(rig.commander.send(FREE))[0] == Result.EPISODE_OVER


# --- endings ------------------------------------------------------------------------------------


def test_newer_action_goal_preempts(rig: Rig) -> None:
    rig.state()
    first = rig.commander.send(FREE)
    second = rig.commander.send(ALSO_FREE)
    assert rig.error(first) == (Result.PREEMPTED, 'goal 2 took its place')
    rig.state(x=4.0, step=1)
    rig.state(y=4.0, step=2)
    assert second.result().success
    [ended] = rig.record.of_kind(EpisodeEvent.ENDED)
    assert (ended.query_id, ended.error_code) == (1, Result.PREEMPTED)


def test_goal_pose_preempts(rig: Rig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    rig.graph.publish('goal_pose', goal_pose(*ALSO_FREE))
    assert rig.error(sent)[0] == Result.PREEMPTED


def test_refused_goal_leaves_the_one_under_way(rig: Rig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    assert not rig.commander.send((8.0, 0.0)).accepted
    rig.state(x=4.0, step=1)
    assert sent.result().success


def test_canceled_goal_stops_the_policy(rig: Rig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    assert sent.cancel()
    assert rig.error(sent) == (Result.CANCELED, 'canceled')
    stop = rig.graph.wait(lambda: len(rig.record.queries) == 2 and rig.record.queries[1], 'stop')
    assert (stop.query_id, stop.active) == (1, False)
    assert not sent.cancel()


def test_steps_of_the_goal_run_out(rig: Rig) -> None:
    rig.state()
    sent = rig.commander.send(FREE, max_steps=2)
    for step in (1, 2):
        rig.state(step=step)
    code, message = rig.error(sent)
    assert (code, message) == (Result.TIMED_OUT, 'not reached in 2 steps, 4.00 m from the goal')
    assert sent.result().steps == 2


def test_episode_ends_under_way(rig: Rig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    rig.state(step=1, truncated=True)
    assert rig.error(sent)[0] == Result.EPISODE_ENDED


@pytest.mark.parametrize('by', ['state', 'started'])
def test_new_episode_ends_the_goal(rig: Rig, by: str) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    getattr(rig, by)(episode_id=2)
    assert rig.error(sent) == (Result.NEW_EPISODE, 'episode 2 began')


def test_goal_sent_right_after_a_reset_belongs_to_the_new_episode(rig: Rig) -> None:
    rig.state(step=9)
    rig.started(2)
    rig.graph.wait(lambda: rig.record.of_kind(EpisodeEvent.STARTED), 'the event')
    sent = rig.commander.send(FREE)
    rig.state(episode_id=2)
    rig.state(x=4.0, step=1, episode_id=2)
    assert sent.result().steps == 1
    assert rig.record.queries[0].episode_id == 2


def test_goal_waits_for_its_episode_and_refuses_one_that_is_over(rig: Rig) -> None:
    rig.state(step=9, episode_id=2, terminated=True)
    old = ReachGoal.Goal(pose=goal_pose(*FREE), episode_id=1, request_id='old')
    assert rig.error(rig.commander.send_request(old)) == (
        Result.EPISODE_OVER,
        'episode 1 is over, 2 is the newest',
    )
    new = ReachGoal.Goal(pose=goal_pose(*FREE), episode_id=3, request_id='new')
    sent = rig.commander.send_request(new)
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


def test_goal_node_that_goes_down_ends_the_goal(rig: Rig) -> None:
    rig.state()
    sent = rig.commander.send(FREE)
    rig.node.end_service()
    assert rig.error(sent)[0] == Result.SHUTDOWN


def test_every_error_code_is_provoked_here() -> None:
    source = Path(__file__).read_text(encoding='utf-8')
    definition = (
        Path(__file__)
        .parents[2]
        .joinpath('ros2_ws/src/metagcttt_interfaces/action/ReachGoal.action')
    )
    named = re.findall(r'^uint16 (\w+)=', definition.read_text(encoding='utf-8'), re.MULTILINE)
    assert len(named) == 15
    assert [name for name in named if f'Result.{name}' not in source] == []


# --- the client ---------------------------------------------------------------------------------


def test_blocking_call_cancels_what_takes_too_long(rig: Rig) -> None:
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
    result = commander.reach(goal, max_steps=20)
    assert (result.success, result.error_code) == (False, Result.TIMED_OUT)
    assert result.steps == 20
    commander.set_task(1)
    sent = commander.send(goal)
    graph.wait(lambda: sent.feedback and sent.feedback.adapted, 'the expert')
    assert goals.stop(signal_number=signal.SIGTERM) == 0
    assert sent.result(5).error_code == Result.SHUTDOWN
    assert not queries[-1].active
    commander.destroy_node()
