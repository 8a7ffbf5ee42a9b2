from collections.abc import Iterable
from itertools import groupby
import re
import time

from metagcttt.sim.node import SimBridgeNode
from metagcttt_interfaces.msg import ActionCommand, EpisodeEvent, MazeState
from nav_msgs.msg import OccupancyGrid
import numpy as np
import pytest
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sim_bridge import make_simulator
from std_srvs.srv import SetBool, Trigger
from tests.ros.graph import ANY, EVERY, Graph, Record, RELIABLE

pytestmark = pytest.mark.mujoco


def answer(state, values=(1.0, 0.0), **changes) -> ActionCommand:
    fields = {'episode_id': state.episode_id, 'step': state.step, 'values': list(values)}
    return ActionCommand(**{**fields, **changes})


def seconds(stamp) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


def test_reliable_subscriber_receives_states_in_realtime(graph: Graph) -> None:
    graph.add(SimBridgeNode, speed_factor=5.0)
    states = graph.collect(MazeState, 'state', RELIABLE)
    graph.wait(lambda: len(states) > 5, 'states')
    steps = [state.step for state in states]
    assert steps == list(range(steps[0], steps[0] + len(steps)))


def unlike(states: Iterable[MazeState]) -> list[MazeState]:
    """States without the repetitions of one that waits for its action for a second."""
    return [state for state, _ in groupby(states)]


def test_lockstep_episode_equals_the_simulator(graph: Graph) -> None:
    graph.add(SimBridgeNode, stepping='lockstep')
    record = Record(graph, EVERY)
    task = graph.set_task(3, seed=11)
    graph.wait(lambda: record.states and record.states[-1].episode_id == 2, 'the first state')
    first = record.states[-1]
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (30, 2))
    for number, action in enumerate(actions):
        graph.publish('action', answer(record.states[-1], action))
        graph.wait(lambda number=number: record.states[-1].step == number + 1, 'the next state')
    states = unlike(state for state in record.states if state.episode_id == first.episode_id)

    with make_simulator('pointmaze-medium-v0') as simulator:
        observation, goal = simulator.reset(task_id=3, seed=11)
        expected = [observation, *(simulator.step(action).observation for action in actions)]
    np.testing.assert_array_equal([state.observation for state in states], expected)
    assert list(task.goal) == goal.tolist()
    assert list(task.observation) == observation.tolist()
    assert [state.step for state in states] == list(range(31))
    period = np.diff([seconds(state.header.stamp) for state in states])
    np.testing.assert_allclose(period, 0.1)


def test_tasks_of_a_humanoid_start_standing_on_request(graph: Graph) -> None:
    graph.add(
        SimBridgeNode, stepping='lockstep', environment='humanoidmaze-medium-v0', standing=True
    )
    task = graph.set_task(1, seed=3)
    with make_simulator('humanoidmaze-medium-v0', standing=True) as simulator:
        observation, goal = simulator.reset(task_id=1, seed=3)
    assert list(task.observation) == observation.tolist()
    assert list(task.goal) == goal.tolist()


def test_lockstep_ignores_actions_for_other_states(graph: Graph) -> None:
    graph.add(SimBridgeNode, stepping='lockstep')
    states = Record(graph, EVERY).states
    graph.wait(lambda: states, 'the first state')
    for wrong in ({'step': 1}, {'episode_id': 7}, {'values': [1.0]}, {'values': [np.nan, 0.0]}):
        graph.publish('action', answer(states[0], **wrong))
    graph.publish('action', answer(states[0], (0.0, 0.0)))
    graph.wait(lambda: states[-1].step, 'the next state')
    assert [state.step for state in unlike(states)] == [0, 1]


def test_lockstep_state_is_repeated_for_a_partner_that_joins_late(graph: Graph) -> None:
    graph.add(SimBridgeNode, stepping='lockstep')
    states = graph.collect(MazeState, 'state', ANY)  # which gets nothing from before
    graph.wait(lambda: len(states) >= 3, 'repetitions', timeout_s=15)
    assert {state.step for state in states} == {0}
    graph.publish('action', answer(states[-1], (0.0, 0.0), world_id=states[-1].world_id))
    graph.wait(lambda: states[-1].step == 1, 'the next state')


def test_every_simulator_draws_its_world_and_ignores_actions_for_others(graph: Graph) -> None:
    first = graph.add(SimBridgeNode, stepping='lockstep')
    states = Record(graph, EVERY).states
    old = graph.wait(lambda: states, 'the first state')[0]
    graph.remove(first)
    graph.add(SimBridgeNode, stepping='lockstep')
    new = graph.wait(lambda: states[-1].world_id != old.world_id and states[-1], 'a new world')
    assert (new.episode_id, new.step, 0 in (new.world_id, old.world_id)) == (1, 0, False)
    assert graph.set_task(1).world_id == new.world_id
    graph.wait(lambda: states[-1].episode_id == 2, 'the task')
    graph.publish('action', answer(states[-1], world_id=old.world_id))
    graph.publish('action', answer(states[-1], (0.0, 0.0), world_id=new.world_id))
    graph.wait(lambda: states[-1].step == 1, 'the step')
    assert abs(states[-1].position.x) < 0.2


def test_set_task_announces_the_goal(graph: Graph) -> None:
    graph.add(SimBridgeNode, stepping='lockstep')
    record = Record(graph, EVERY)
    task = graph.set_task(2, seed=5)
    quiet = graph.set_task(2, seed=5, send_goal=False)
    started = graph.wait(
        lambda: len(found := record.of_kind(EpisodeEvent.STARTED)) == 3 and found, 'the events'
    )
    assert [event.episode_id for event in started] == [1, 2, 3]
    assert [list(event.goal) for event in started] == [[], list(task.goal), []]
    assert started[1].seed == 5
    assert (task.goal_position.x, task.goal_position.y) == tuple(task.goal)
    assert list(quiet.goal) == list(task.goal)


@pytest.mark.parametrize(
    ('task_id', 'seed', 'message'),
    [(6, 0, 'task_id must be from 1 to 5, got 6'), (1, 2**32, 'seed must be from 0')],
)
def test_set_task_refuses_and_changes_nothing(
    graph: Graph, task_id: int, seed: int, message: str
) -> None:
    graph.add(SimBridgeNode, stepping='lockstep')
    record = Record(graph, EVERY)
    response = graph.set_task(task_id, seed=seed)
    assert not response.success
    assert message in response.message
    assert graph.set_task(1).episode_id == 2
    started = graph.wait(
        lambda: len(found := record.of_kind(EpisodeEvent.STARTED)) == 2 and found, 'the events'
    )
    assert [event.episode_id for event in started] == [1, 2]


def test_reset_begins_an_episode_without_a_task(graph: Graph) -> None:
    graph.add(SimBridgeNode, stepping='lockstep')
    states = Record(graph, EVERY).states
    response = graph.call(Trigger, 'reset', Trigger.Request())
    assert (response.success, response.message) == (True, 'episode 2 began, without a task')
    state = graph.wait(lambda: states and states[-1].episode_id == 2 and states[-1], 'the state')
    assert state.step == 0


def test_realtime_moves_with_the_newest_action_until_it_is_too_old(graph: Graph) -> None:
    graph.add(SimBridgeNode, speed_factor=50.0, action_timeout_s=0.35)
    states = Record(graph, ANY).states
    graph.set_task(1)
    first = graph.wait(lambda: states and states[-1].episode_id == 2 and states[-1], 'the task')
    graph.publish('action', answer(first, (1.0, 0.0)))
    graph.wait(lambda: states[-1].position.x > first.position.x + 0.1, 'a motion')

    def stands() -> bool:
        last = [state.position.x for state in states[-3:]]
        return last == pytest.approx([last[0]] * 3, abs=1e-3)

    graph.wait(stands, 'its end')
    # 0.35 s are four control periods, of 0.2 m each; a wall is farther.
    assert states[-1].position.x < first.position.x + 1.5


def test_finished_episode_stands_still_until_reset(graph: Graph) -> None:
    node = graph.add(SimBridgeNode, stepping='lockstep')
    states = Record(graph, EVERY).states
    goal = graph.set_task(1).goal
    node._simulator._env.set_xy(np.array(goal))
    graph.wait(lambda: states and states[-1].episode_id == 2, 'the first state')
    graph.publish('action', answer(states[-1], (0.0, 0.0)))
    end = graph.wait(lambda: states[-1].step == 1 and states[-1], 'the last state')
    assert (end.terminated, end.success) == (True, True)
    graph.publish('action', answer(end))
    graph.call(Trigger, 'reset', Trigger.Request())
    graph.wait(lambda: states[-1].episode_id == 3, 'the next episode')
    assert [state.step for state in unlike(states) if state.episode_id == 2] == [0, 1]


def test_map_shows_the_walls(graph: Graph) -> None:
    graph.add(SimBridgeNode, frame_id='maze')
    maps = graph.collect(OccupancyGrid, 'map')
    grid = graph.wait(lambda: maps and maps[0], 'the map')
    with make_simulator('pointmaze-medium-v0') as simulator:
        walls = simulator.maze.walls
    assert grid.header.frame_id == 'maze'
    assert (grid.info.height, grid.info.width) == walls.shape
    np.testing.assert_array_equal(np.array(grid.data).reshape(walls.shape), 100 * walls)
    # Task 1 starts in the free cell at (0, 0).
    corner = grid.info.origin.position
    column, row = int(-corner.x / grid.info.resolution), int(-corner.y / grid.info.resolution)
    assert grid.data[row * grid.info.width + column] == 0


def test_clock_carries_the_time_of_the_states(graph: Graph) -> None:
    graph.add(SimBridgeNode, speed_factor=20.0)
    states = Record(graph, ANY).states
    clocks = graph.collect(Clock, '/clock', ANY)
    graph.wait(lambda: len(clocks) > 5 and len(states) > 5, 'the clock')
    stamps = {seconds(state.header.stamp) for state in states}
    assert {seconds(message.clock) for message in clocks} & stamps
    assert np.diff([seconds(message.clock) for message in clocks]).min() > 0


def test_clock_can_be_left_to_others(graph: Graph) -> None:
    graph.add(SimBridgeNode, publish_clock=False)
    assert graph.node.count_publishers('/clock') == 0


def test_speed_factor_applies_at_once(graph: Graph) -> None:
    node = graph.add(SimBridgeNode, speed_factor=0.01)
    states = Record(graph, ANY).states
    [result] = node.set_parameters([Parameter('speed_factor', value=50.0)])
    assert result.successful
    graph.wait(lambda: len(states) > 3, 'states at the new pace', timeout_s=20)


def pause(graph: Graph, paused: bool) -> str:
    response = graph.call(SetBool, 'pause', SetBool.Request(data=paused))
    assert response.success
    return response.message


def test_paused_world_moves_by_single_steps_only(graph: Graph) -> None:
    graph.add(SimBridgeNode, speed_factor=20.0)
    states = Record(graph, ANY).states
    clocks = graph.collect(Clock, '/clock', ANY)
    graph.set_task(1)
    graph.wait(lambda: states and states[-1].step > 3, 'a few steps')
    assert not graph.call(Trigger, 'step', Trigger.Request()).success
    paused_at = re.match(r'paused, step (\d+) of episode 2$', pause(graph, True))
    # States from before may still be under way.
    graph.wait(lambda: states[-1].step == int(paused_at[1]), 'the state that is published on')
    count, stopped = len(states), states[-1]
    graph.publish('action', answer(stopped, (1.0, 0.0)))
    graph.wait(lambda: len(states) > count + 8, 'more of the same')
    assert {(s.step, seconds(s.header.stamp)) for s in states[count:]} == {
        (stopped.step, seconds(stopped.header.stamp))
    }
    graph.wait(lambda: clocks[-1].clock == stopped.header.stamp, 'its time')
    for number in range(1, 4):
        response = graph.call(Trigger, 'step', Trigger.Request())
        assert response.success
        assert response.message == f'step {stopped.step + number} of episode 2'
    graph.wait(lambda: states[-1].step == stopped.step + 3, 'three steps')
    elapsed = seconds(states[-1].header.stamp) - seconds(stopped.header.stamp)
    assert elapsed == pytest.approx(0.3)
    assert states[-1].position.x > stopped.position.x
    assert pause(graph, False).startswith('running, step')
    graph.wait(lambda: states[-1].step > stopped.step + 6, 'the world to go on')


def test_paused_lockstep_keeps_the_action_until_the_step(graph: Graph) -> None:
    graph.add(SimBridgeNode, stepping='lockstep', start_paused=True)
    states = Record(graph, EVERY).states
    graph.wait(lambda: states, 'the first state')
    early = graph.call(Trigger, 'step', Trigger.Request())
    assert (early.success, early.message) == (
        False,
        'no action was received for step 0 of episode 1',
    )
    graph.publish('action', answer(states[0]))
    graph.wait(lambda: graph.call(Trigger, 'step', Trigger.Request()).success, 'the step')
    graph.wait(lambda: states[-1].step == 1, 'the state')
    graph.publish('action', answer(states[-1]))
    assert not any(state.step > 1 for state in states)
    pause(graph, False)
    graph.wait(lambda: states[-1].step == 2, 'the action that waited')


def test_pace_keeps_to_the_clock_of_the_wall(graph: Graph) -> None:
    graph.add(SimBridgeNode, speed_factor=10.0)
    lags: list[tuple[float, float]] = []

    def hear(message: Clock) -> None:
        now = time.monotonic()
        lags.append((now, 10.0 * now - seconds(message.clock)))

    graph.node.create_subscription(Clock, '/clock', hear, ANY)
    graph.wait(lambda: lags, 'the clock')
    graph.wait(lambda: lags[-1][0] - lags[0][0] > 3.0, 'three seconds')
    # Other programs can only make a message late: the least lag of a second is the pace's own.
    first = min(lag for now, lag in lags if now < lags[0][0] + 1.0)
    last = min(lag for now, lag in lags if now > lags[-1][0] - 1.0)
    assert last - first == pytest.approx(0.0, abs=0.4)  # of more than 20 s


def test_unknown_environment_is_refused_with_the_nearest(graph: Graph) -> None:
    with pytest.raises(ValueError, match="did you mean 'pointmaze-medium-v0'"):
        graph.add(SimBridgeNode, environment='pointmaze-medum-v0')
