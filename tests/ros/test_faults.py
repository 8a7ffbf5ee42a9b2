"""What goes wrong around the nodes: a zero action, a diagnostic that says why, recovery."""

from collections.abc import Callable
from itertools import permutations
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
from metagcttt.goal_node import GoalNode
from metagcttt.policy_node import PolicyNode
from metagcttt.sim_bridge_node import SimBridgeNode
from metagcttt_interfaces.msg import ActionCommand, GoalQuery, MazeState
import numpy as np
import pytest
from rclpy.node import Node
from std_srvs.srv import SetBool

from tests.ros.graph import EVERY, goal_pose, Graph, Record, RELIABLE

GOAL = (20.0, 20.0)
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Rig:
    """A policy in realtime; the test plays the simulator and the goal node."""

    def __init__(self, graph: Graph, files: dict[str, str], **parameters) -> None:
        self.graph = graph
        defaults = {
            'adapt_steps': 2,
            'adapt_batch_size': 16,
            'rate_hz': 50.0,
            # So long that a busy machine does not turn another fault into this one.
            'state_timeout_s': 5.0,
            'diagnostics_period_s': 0.05,
            # Of what is measured here, some depends on the machine.
            'warn_latency_ms': 10000.0,
            'warn_missed_deadlines': 10**6,
        }
        self._parameters = {**defaults, **files, **parameters}
        self.node = graph.add(PolicyNode, **self._parameters)
        self.record = Record(graph)
        self.diagnostics = graph.collect(DiagnosticArray, '/diagnostics', RELIABLE)
        self._states = graph.node.create_publisher(MazeState, 'state', EVERY)
        self._goals = graph.node.create_publisher(GoalQuery, 'goal', EVERY)
        self._step = 0

    def another_policy(self) -> Node:
        return self.graph.add(PolicyNode, **self._parameters)

    def state(self, observation=(0.0, 0.0), step: int | None = None, episode_id: int = 1) -> None:
        self._step += 1
        step = self._step if step is None else step
        self._states.publish(
            MazeState(episode_id=episode_id, step=step, observation=list(observation))
        )

    def goal(self, query_id: int = 1, goal=GOAL, episode_id: int = 1) -> None:
        self._goals.publish(
            GoalQuery(query_id=query_id, episode_id=episode_id, active=True, goal=list(goal))
        )

    def drive(self) -> None:
        """Wait until the robot moves, with fresh states."""
        self.record.actions.clear()

        def moves() -> bool:
            self.state()
            return any(any(action.values) for action in self.record.actions)

        self.graph.wait(moves, 'an action that moves the robot')

    def wait_for_zero(self) -> None:
        self.record.actions.clear()
        self.graph.wait(
            lambda: self.record.actions and not any(self.record.actions[-1].values),
            'a zero action',
        )

    def diagnosed(self, level: bytes, message: str, node: str = '/policy_node', fresh=True):
        """Wait for a diagnostic, while states go on unless they are not to be `fresh`."""
        self.diagnostics.clear()

        def found():
            if fresh and self._states is not None:
                self.state()
            for array in self.diagnostics:
                for status in array.status:
                    if (status.name, status.level) == (node, level) and message in status.message:
                        return status
            return None

        return self.graph.wait(found, f'{node}: {level} {message}')


@pytest.fixture
def make_rig(graph: Graph, checkpoint_folder: Path, dataset_file: Path) -> Callable[..., Rig]:
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    return lambda **parameters: Rig(graph, files, **parameters)


@pytest.fixture
def rig(make_rig) -> Rig:
    rig = make_rig()
    rig.goal()
    rig.drive()
    return rig


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


# --- the policy: states -------------------------------------------------------------------------


def test_stale_state(rig: Rig) -> None:
    rig.wait_for_zero()
    rig.diagnosed(ERROR, 'the action is zero: no state for ', fresh=False)
    rig.drive()
    rig.diagnosed(OK, 'acting with the adapted policy')


def test_non_finite_state(rig: Rig) -> None:
    rig.state((float('nan'), 0.0))
    rig.wait_for_zero()
    status = rig.diagnosed(ERROR, 'the action is zero: the state is not finite', fresh=False)
    assert values(status)['malformed_states'] == '1'
    rig.drive()


def test_short_fault_is_diagnosed_after_it_is_gone(make_rig) -> None:
    rig = make_rig(diagnostics_period_s=0.5)
    rig.goal()
    rig.drive()
    rig.state((1.0,))
    rig.graph.wait_for(0.05)
    rig.diagnosed(ERROR, 'just now: the state has 1 values, 2 are needed')


def test_out_of_order_state(rig: Rig) -> None:
    rig.state(step=0)
    rig.wait_for_zero()
    status = rig.diagnosed(ERROR, 'state 0 of episode 1 came after state', fresh=False)
    assert values(status)['states_out_of_order'] == '1'
    rig.drive()


def test_states_of_a_restarted_simulator_are_taken(rig: Rig) -> None:
    rig._step = -1
    rig.drive()
    assert rig.node._session._order._newest < (1, 100)


def test_publisher_of_states_vanishes_and_comes_back(rig: Rig) -> None:
    rig.graph.node.destroy_publisher(rig._states)
    rig.wait_for_zero()
    rig.diagnosed(ERROR, 'the action is zero', fresh=False)
    rig._states = rig.graph.node.create_publisher(MazeState, 'state', EVERY)
    rig.drive()


numbers = st.one_of(
    st.floats(), st.sampled_from([1e308, -1e39, 3e38, 5e-324, float('nan'), float('-inf')])
)
uint32 = st.integers(0, 2**32 - 1)


@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    st.builds(
        MazeState,
        episode_id=uint32,
        step=uint32,
        observation=st.lists(numbers, max_size=4),
        terminated=st.booleans(),
        truncated=st.booleans(),
    )
)
def test_generated_states_give_finite_actions_and_stop_no_node(
    rig: Rig, message: MazeState
) -> None:
    rig.record.actions.clear()
    rig._states.publish(message)
    rig.graph.wait(lambda: len(rig.record.actions) >= 2, 'actions')
    for action in rig.record.actions:
        assert np.isfinite(action.values).all()
        assert np.abs(action.values).max() <= 1


def test_robot_drives_again_after_generated_states(rig: Rig) -> None:
    for observation in ((1e308, 0.0), (3e38, -3e38), (), (0.0,) * 1000):
        rig.state(observation)
    rig.wait_for_zero()
    rig.drive()


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(query_id=uint32, episode_id=uint32, goal=st.lists(numbers, max_size=4))
def test_generated_goals_give_finite_actions_and_stop_no_node(
    rig: Rig, query_id: int, episode_id: int, goal: list[float]
) -> None:
    rig.goal(query_id, goal, episode_id)
    rig.record.actions.clear()
    rig.state()
    rig.graph.wait(lambda: len(rig.record.actions) >= 2, 'actions')
    assert all(np.isfinite(action.values).all() for action in rig.record.actions)


# --- the policy: everything else ----------------------------------------------------------------


def test_disabled_robot_stands_still_until_it_is_enabled(rig: Rig) -> None:
    response = rig.graph.call(SetBool, 'enable', SetBool.Request(data=False))
    assert (response.success, response.message) == (True, 'disabled: every action is zero')
    rig.state()
    rig.wait_for_zero()
    rig.diagnosed(ERROR, 'the action is zero: disabled by the service enable')
    assert rig.graph.call(SetBool, 'enable', SetBool.Request(data=True)).message == 'enabled'
    rig.drive()


def test_disabling_answers_with_zero_in_lockstep(make_rig) -> None:
    rig = make_rig(stepping='lockstep')
    rig.graph.call(SetBool, 'enable', SetBool.Request(data=False))
    rig.goal()
    rig.state(step=0)
    rig.wait_for_zero()


def test_second_policy_stops_both_until_it_is_gone(rig: Rig) -> None:
    rival = rig.another_policy()
    rig.diagnosed(ERROR, 'the action is zero: another policy node acts in this graph')
    rig.state()
    rig.wait_for_zero()
    rig.graph.remove(rival)
    rig.drive()
    rig.diagnosed(OK, 'acting with the adapted policy')


def test_foreign_publisher_of_actions_is_reported(rig: Rig) -> None:
    foreign = rig.graph.node.create_publisher(ActionCommand, 'action', RELIABLE)
    rig.drive()
    assert values(rig.diagnosed(WARN, '2 nodes publish actions'))['action_publishers'] == '2'
    rig.graph.node.destroy_publisher(foreign)
    rig.drive()
    rig.diagnosed(OK, 'acting with the adapted policy')


def test_base_policy_is_degraded_and_says_why(make_rig) -> None:
    rig = make_rig(adapt_steps=0)
    rig.goal()
    rig.drive()
    rig.diagnosed(WARN, 'acting with the base policy: adaptation is switched off (0 steps)')


def test_diagnostics_have_figures(rig: Rig) -> None:
    rig.drive()
    figures = values(rig.diagnosed(OK, 'acting'))
    assert float(figures['state_rate_hz']) > 0
    assert float(figures['action_rate_hz']) > 0
    assert float(figures['latency_p99_ms']) >= float(figures['latency_median_ms']) > 0
    assert float(figures['adapt_last_ms']) > 0
    assert figures['adaptations_pending'] == '0'


@pytest.mark.parametrize(
    ('limits', 'message'),
    [
        ({'warn_latency_ms': 0.0}, '99 % of actions within'),
        ({'warn_adapt_ms': 0.0}, 'the adaptation took'),
    ],
)
def test_thresholds_are_parameters(make_rig, limits: dict, message: str) -> None:
    rig = make_rig(**limits)
    rig.goal()
    rig.drive()
    rig.diagnosed(WARN, message)


def test_failed_configuration_is_diagnosed(make_rig, tmp_path: Path) -> None:
    rig = make_rig(dataset=str(tmp_path / 'nowhere.npz'))
    rig.diagnosed(ERROR, 'cannot configure: ')


# --- the other nodes ----------------------------------------------------------------------------


def test_simulator_reports_what_it_does_with_actions(graph: Graph, make_rig) -> None:
    rig = make_rig(diagnostics_period_s=3600.0)
    graph.node.destroy_publisher(rig._states)
    rig._states = None
    graph.add(SimBridgeNode, diagnostics_period_s=0.05, speed_factor=10.0, action_timeout_s=10.0)
    actions = graph.node.create_publisher(ActionCommand, 'action', RELIABLE)

    def act(value: float) -> None:
        actions.publish(ActionCommand(episode_id=1, values=[value, 0.0]))

    rig.diagnosed(WARN, '2 nodes publish actions', '/sim_bridge_node')
    graph.remove(rig.node)
    act(0.0)
    rig.diagnosed(OK, 'stepping', '/sim_bridge_node')
    act(float('nan'))
    rig.diagnosed(ERROR, 'an action was ignored: the action is not finite', '/sim_bridge_node')
    rig.diagnosed(WARN, 'the action is zero: none has come lately', '/sim_bridge_node')
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
    silence = 'a goal is in force, but no policy is to be heard'
    rig.diagnosed(WARN, silence, '/goal_node', fresh=False)


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
