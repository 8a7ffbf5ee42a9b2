"""What goes wrong around the simulator and the goal node, and in which order nodes start."""

from collections.abc import Callable
from itertools import permutations
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from metagcttt.goal.node import GoalNode
from metagcttt.policy.node import PolicyNode
from metagcttt.sim.node import SimBridgeNode
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import ActionCommand, EpisodeEvent, GoalQuery, MazeState
import pytest
from rclpy.parameter import Parameter

from tests.ros.fault_rig import ERROR, FaultRig, OK, WARN
from tests.ros.graph import ANY, EVERY, goal_pose, Graph, Record, RELIABLE


@pytest.fixture
def make_rig(graph: Graph, checkpoint_folder: Path, dataset_file: Path) -> Callable[..., FaultRig]:
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    return lambda **parameters: FaultRig(graph, files, **parameters)


def test_simulator_reports_what_it_does_with_actions(graph: Graph, make_rig) -> None:
    rig = make_rig(diagnostics_period_s=3600.0)
    graph.node.destroy_publisher(rig._states)
    rig._states = None
    graph.add(SimBridgeNode, diagnostics_period_s=0.05, speed_factor=10.0, action_timeout_s=30.0)
    actions = graph.node.create_publisher(ActionCommand, 'action', RELIABLE)

    def act(value: float) -> None:
        actions.publish(ActionCommand(episode_id=1, values=[value, 0.0]))

    rig.diagnosed(WARN, '2 nodes publish actions', '/sim_bridge_node')
    graph.remove(rig.node)
    act(0.0)
    rig.diagnosed(OK, 'stepping', '/sim_bridge_node')
    act(float('nan'))
    rig.diagnosed(ERROR, 'an action was ignored: the action is not finite', '/sim_bridge_node')
    rig.diagnosed(WARN, 'the action is zero: none was received recently', '/sim_bridge_node')
    act(0.0)
    rig.diagnosed(OK, 'stepping', '/sim_bridge_node')
    graph.node.destroy_publisher(actions)
    rig.diagnosed(WARN, 'nobody publishes actions', '/sim_bridge_node')


def test_goal_node_reports_states_and_a_missing_policy(
    graph: Graph, dataset_file: Path, make_rig
) -> None:
    rig = make_rig()
    rig.state()
    graph.add(GoalNode, dataset=str(dataset_file), diagnostics_period_s=0.05)
    rig.diagnosed(OK, 'no goal', '/goal_node')
    rig.state((float('nan'), 0.0))
    rig.diagnosed(ERROR, 'a state was ignored: the state is not finite', '/goal_node', fresh=False)
    rig.state()
    graph.remove(rig.node)
    graph.publish('goal_pose', goal_pose(0.0, 4.0))
    silence = 'a goal is in force, but no policy status is received'
    rig.diagnosed(WARN, silence, '/goal_node', fresh=False)


@pytest.mark.mujoco
def test_robot_stands_still_while_two_nodes_send_actions(graph: Graph) -> None:
    graph.add(SimBridgeNode, diagnostics_period_s=0.05, speed_factor=5.0)
    states = graph.collect(MazeState, 'state', ANY)
    diagnostics = graph.collect(DiagnosticArray, '/diagnostics', RELIABLE)
    actions = graph.node.create_publisher(ActionCommand, 'action', RELIABLE)
    graph.wait(lambda: states and actions.get_subscription_count(), 'the simulator')

    def travelled_m(*instances: int) -> float:
        """How far the robot moves while these nodes push it to and fro for a while."""
        diagnostics.clear()
        positions = []
        for number in range(40):
            for instance in instances:
                values = [1.0 if number % 20 < 10 else -1.0, 0.0]
                actions.publish(ActionCommand(episode_id=1, values=values, instance=instance))
            graph.wait_for(0.025)
            positions.append(states[-1].position.x)
        return max(positions[20:]) - min(positions[20:])

    def messages() -> set[str]:
        return {status.message for array in diagnostics for status in array.status}

    assert travelled_m(1) > 0.1
    assert 'stepping' in messages()
    assert travelled_m(1, 2) < 0.05
    assert 'the action is zero: 2 nodes send actions' in messages()
    graph.wait_for(1.2)  # until the second one counts as silent
    assert travelled_m(1) > 0.1


@pytest.mark.mujoco
def test_slow_simulator_is_heard_between_its_steps(graph: Graph) -> None:
    graph.add(SimBridgeNode, speed_factor=0.01)  # ten seconds a step
    states = graph.collect(MazeState, 'state', ANY)
    graph.wait(lambda: len(states) >= 6, 'states', timeout_s=15)
    assert {state.step for state in states} <= {0, 1}


def test_goal_node_repeats_the_goal_in_force_until_it_is_over(
    graph: Graph, dataset_file: Path
) -> None:
    goal_node = graph.add(GoalNode, dataset=str(dataset_file), goal_lease_s=0.4)
    queries = graph.collect(GoalQuery, 'goal')
    states = graph.node.create_publisher(MazeState, 'state', EVERY)
    states.publish(MazeState(episode_id=1, observation=[0.0, 0.0]))
    graph.wait(lambda: goal_node._tracker.state, 'the state')
    graph.publish('goal_pose', goal_pose(0.0, 4.0))
    graph.wait(lambda: len(queries) >= 4, 'repetitions')
    assert all(query == queries[0] for query in queries)
    assert (queries[0].active, queries[0].lease_s) == (True, 0.4)
    states.publish(MazeState(episode_id=2, observation=[0.0, 0.0]))
    graph.wait(lambda: not queries[-1].active, 'the end of the goal')
    known = len(queries)
    graph.wait_for(0.5)
    assert len(queries) == known
    goal_node.set_parameters([Parameter('goal_lease_s', value=0.0)])
    graph.publish('goal_pose', goal_pose(0.0, 4.0))
    graph.wait(lambda: queries[-1].active, 'a goal that is not repeated')
    assert queries[-1].lease_s == 0.0
    graph.wait_for(0.5)
    assert len(queries) == known + 1


def test_goal_is_given_up_when_simulated_time_stops_with_its_simulator(
    graph: Graph, dataset_file: Path
) -> None:
    goal_node = graph.add(
        GoalNode, dataset=str(dataset_file), use_sim_time=True, state_timeout_s=0.3
    )
    record = Record(graph, EVERY)
    states = graph.node.create_publisher(MazeState, 'state', EVERY)
    states.publish(MazeState(episode_id=1, observation=[0.0, 0.0]))
    graph.wait(lambda: goal_node._tracker.state, 'the state')
    graph.publish('goal_pose', goal_pose(0.0, 4.0))
    ended = graph.wait(lambda: record.of_kind(EpisodeEvent.ENDED), 'the end')
    assert ended[0].error_code == ReachGoal.Result.STATE_LOST


@pytest.mark.mujoco
@pytest.mark.parametrize('order', list(permutations(range(3))), ids=str)
def test_nodes_may_start_in_any_order(
    graph: Graph, checkpoint_folder: Path, dataset_file: Path, order: tuple[int, ...]
) -> None:
    dataset = {'dataset': str(dataset_file)}
    policy = {'checkpoint': str(checkpoint_folder), 'adapt_steps': 1, 'rate_hz': 50.0}
    starts = (
        lambda: graph.add(SimBridgeNode, speed_factor=5.0),
        lambda: graph.add(GoalNode, **dataset),
        lambda: graph.add(PolicyNode, **dataset, **policy),
    )
    record = Record(graph)
    for number in order:
        starts[number]()
        graph.wait_for(0.3)
    graph.set_task(1)
    graph.wait(lambda: any(action.adapted for action in record.actions), 'the expert')
