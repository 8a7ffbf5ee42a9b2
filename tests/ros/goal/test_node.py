from pathlib import Path

from metagcttt.goal.node import GoalNode
from metagcttt_core import DatasetError
from metagcttt_interfaces.msg import EpisodeEvent, MazeState
import pytest
from tests.ros.graph import EVERY, goal_pose, Graph, Record

ACCEPTED = EpisodeEvent.GOAL_ACCEPTED
REJECTED = EpisodeEvent.GOAL_REJECTED


class Rig:
    """A goal node in lockstep, and a simulator that the test plays."""

    def __init__(self, graph: Graph, dataset: Path, **parameters) -> None:
        self.graph = graph
        self.node = graph.add(GoalNode, dataset=str(dataset), stepping='lockstep', **parameters)
        self.record = Record(graph, EVERY)
        self._states = graph.node.create_publisher(MazeState, 'state', EVERY)
        self._events = graph.node.create_publisher(EpisodeEvent, 'episode', EVERY)
        graph.wait(
            lambda: (
                self._states.get_subscription_count() == 2
                and self._events.get_subscription_count() == 2
            ),
            'the goal node',
        )

    def state(self, x: float = 0.0, y: float = 0.0, step: int = 0, episode_id: int = 1, **flags):
        message = MazeState(episode_id=episode_id, step=step, observation=[x, y], **flags)
        message.position.x, message.position.y = x, y
        self._states.publish(message)
        known = len(self.record.states)
        self.graph.wait(lambda: len(self.record.states) > known, 'the state')
        return message

    def started(self, episode_id: int, goal=(), seed: int = 0) -> None:
        self._events.publish(
            EpisodeEvent(
                kind=EpisodeEvent.STARTED, episode_id=episode_id, goal=list(goal), seed=seed
            )
        )

    def send(self, *args, **kwargs) -> None:
        self.graph.publish('goal_pose', goal_pose(*args, **kwargs))

    def event(self, kind: int, number: int = 1) -> EpisodeEvent:
        return self.graph.wait(
            lambda: len(found := self.record.of_kind(kind)) >= number and found[number - 1],
            f'event {number} of kind {kind}',
        )

    def query(self, number: int):
        return self.graph.wait(
            lambda: len(self.record.queries) >= number and self.record.queries[number - 1],
            f'query {number}',
        )


@pytest.fixture
def rig(graph: Graph, dataset_file: Path) -> Rig:
    return Rig(graph, dataset_file)


def test_goal_pose_becomes_a_query_in_the_current_episode(rig: Rig) -> None:
    rig.state(episode_id=4, step=17)
    rig.send(4.0, 0.5)
    query = rig.query(1)
    assert (query.query_id, query.episode_id, query.active, query.seed) == (1, 4, True, 0)
    assert list(query.goal) == [4.0, 0.5]
    assert (query.position.x, query.position.y) == (4.0, 0.5)
    assert query.header.frame_id == 'map'
    event = rig.event(ACCEPTED)
    assert (event.query_id, event.episode_id, event.step) == (1, 4, 17)


@pytest.mark.parametrize(
    ('x', 'y', 'frame', 'reason'),
    [
        (8.0, 0.0, 'map', 'in a wall, cell (1, 3)'),
        (100.0, 0.0, 'map', 'outside the maze, which spans x -6 to 26'),
        (0.0, float('nan'), 'map', 'not finite'),
        (0.0, 0.0, 'odom', "the goal is in frame 'odom', goals are in 'map'"),
        (0.0, 0.0, '', "in frame '', goals are in 'map'"),
    ],
)
def test_goal_is_rejected_with_the_reason(
    rig: Rig, x: float, y: float, frame: str, reason: str
) -> None:
    rig.state()
    rig.send(x, y, frame)
    assert reason in rig.event(REJECTED).reason
    assert rig.record.queries == []


def test_goal_before_the_first_state_is_rejected(rig: Rig) -> None:
    rig.send(0.0, 0.0)
    assert rig.event(REJECTED).reason == 'no state of the simulator has arrived yet'


def test_goal_after_the_episode_ended_is_rejected(rig: Rig) -> None:
    rig.state(truncated=True)
    rig.send(4.0, 0.0)
    assert 'episode 1 has ended' in rig.event(REJECTED).reason


def test_rejected_goal_leaves_the_one_in_force(rig: Rig) -> None:
    rig.state()
    rig.send(4.0, 0.0)
    rig.event(ACCEPTED)
    rig.send(8.0, 0.0)
    rig.event(REJECTED)
    rig.state(x=4.0, step=1)
    assert rig.event(EpisodeEvent.REACHED).query_id == 1


def test_reached_goal_is_switched_off(rig: Rig) -> None:
    rig.state()
    rig.send(4.0, 0.0)
    rig.event(ACCEPTED)
    rig.state(x=2.9, step=1)
    rig.state(x=3.1, step=2)
    event = rig.event(EpisodeEvent.REACHED)
    assert (event.query_id, event.step) == (1, 2)
    assert event.reason == 'after 2 steps, 0.90 m from the goal'
    query = rig.query(2)
    assert (query.query_id, query.active) == (1, False)


def test_tolerance_limit_and_seed_are_parameters(graph: Graph, dataset_file: Path) -> None:
    rig = Rig(graph, dataset_file, goal_tolerance_m=0.1, max_steps=3, seed=9)
    rig.state()
    rig.send(4.0, 0.0)
    assert rig.query(1).seed == 9
    for step in (1, 2, 3):
        rig.state(x=3.5, step=step)
    event = rig.event(EpisodeEvent.TIMED_OUT)
    assert (event.step, event.reason) == (3, 'not reached in 3 steps, 0.50 m from the goal')


def test_newer_goal_replaces_the_one_in_force(rig: Rig) -> None:
    rig.state()
    rig.send(4.0, 0.0)
    rig.event(ACCEPTED)
    rig.send(0.0, 4.0)
    assert rig.query(2).query_id == 2
    rig.state(x=4.0, step=1)
    rig.state(y=4.0, step=2)
    assert rig.event(EpisodeEvent.REACHED).query_id == 2
    assert len(rig.record.of_kind(EpisodeEvent.REACHED)) == 1


def test_new_episode_voids_the_goal(rig: Rig) -> None:
    rig.state()
    rig.send(4.0, 0.0)
    rig.event(ACCEPTED)
    rig.state(x=4.0, episode_id=2)
    query = rig.query(2)
    assert (query.query_id, query.episode_id, query.active) == (1, 1, False)
    assert rig.record.of_kind(EpisodeEvent.REACHED) == []


def test_task_goal_becomes_a_query_with_its_seed(rig: Rig) -> None:
    rig.started(3, goal=(4.25, 0.5), seed=12)
    query = rig.query(1)
    assert (query.episode_id, query.seed, list(query.goal)) == (3, 12, [4.25, 0.5])
    rig.state(x=-9.0, step=1, episode_id=3, terminated=True, success=True)
    assert rig.event(EpisodeEvent.REACHED).query_id == 1


def test_restarted_simulator_voids_the_goal(rig: Rig) -> None:
    rig.started(3, goal=(4.0, 0.0))
    rig.query(1)
    rig.started(1)
    assert not rig.query(2).active


def test_older_episodes_that_are_heard_of_late_leave_the_goal(rig: Rig) -> None:
    rig.state(episode_id=7)
    rig.send(4.0, 0.0)
    rig.query(1)
    before = {'source_timestamp': rig.node._tracker._order._published_ns - 1}
    rig.node._on_event(EpisodeEvent(kind=EpisodeEvent.STARTED, episode_id=1), before)
    assert rig.node._tracker.goal is not None


def test_task_goal_of_another_size_is_rejected(rig: Rig) -> None:
    rig.started(3, goal=(1.0, 2.0, 3.0))
    assert 'the goal has 3 values, 2 are needed' in rig.event(REJECTED).reason


def test_late_goal_node_still_takes_up_the_running_task(graph: Graph, dataset_file: Path) -> None:
    early = graph.node.create_publisher(EpisodeEvent, 'episode', EVERY)
    started = EpisodeEvent(kind=EpisodeEvent.STARTED, episode_id=1, goal=[4.0, 0.0])
    early.publish(started)
    rig = Rig.__new__(Rig)
    graph.add(GoalNode, dataset=str(dataset_file))
    rig.graph, rig.record = graph, Record(graph)
    assert rig.query(1).episode_id == 1


def test_missing_dataset_is_named(graph: Graph, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r'nowhere\.npz'):
        graph.add(GoalNode, dataset=str(tmp_path / 'nowhere.npz'))
