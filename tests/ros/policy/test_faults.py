"""What goes wrong around the policy: a zero action, a diagnostic that says why, recovery."""

from collections.abc import Callable
import math
from pathlib import Path

from geometry_msgs.msg import Point
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
from metagcttt.converters import to_time
from metagcttt_interfaces.msg import ActionCommand, MazeState
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool
from tests.ros.fault_rig import ERROR, FaultRig, OK, values, WARN
from tests.ros.graph import EVERY, Graph, RELIABLE


@pytest.fixture
def make_rig(graph: Graph, checkpoint_folder: Path, dataset_file: Path) -> Callable[..., FaultRig]:
    files = {'checkpoint': str(checkpoint_folder), 'dataset': str(dataset_file)}
    return lambda **parameters: FaultRig(graph, files, **parameters)


@pytest.fixture
def rig(make_rig) -> FaultRig:
    rig = make_rig()
    rig.goal()
    rig.drive()
    return rig


# --- the policy: states -------------------------------------------------------------------------


def test_stale_state(rig: FaultRig) -> None:
    rig.wait_for_zero()
    rig.diagnosed(ERROR, 'the action is zero: no state for ', fresh=False)
    rig.drive()
    rig.diagnosed(OK, 'acting with the adapted policy')


def test_non_finite_state(rig: FaultRig) -> None:
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


def test_out_of_order_state(rig: FaultRig) -> None:
    rig.state(step=0)
    rig.wait_for_zero()
    status = rig.diagnosed(ERROR, 'state 0 of episode 1 came after state', fresh=False)
    assert values(status)['states_out_of_order'] == '1'
    rig.drive()


def test_states_of_a_restarted_simulator_are_taken(rig: FaultRig) -> None:
    rig._step = -1
    rig.drive()
    assert rig.node._session._order.now < (0, 1, 100)


def test_publisher_of_states_vanishes_and_comes_back(rig: FaultRig) -> None:
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
    rig: FaultRig, message: MazeState
) -> None:
    rig.record.actions.clear()
    rig._states.publish(message)
    rig.graph.wait(lambda: len(rig.record.actions) >= 2, 'actions')
    for action in rig.record.actions:
        assert np.isfinite(action.values).all()
        assert np.abs(action.values).max() <= 1


def test_robot_drives_again_after_generated_states(rig: FaultRig) -> None:
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
    rig: FaultRig, query_id: int, episode_id: int, goal: list[float]
) -> None:
    rig.goal(query_id, goal, episode_id)
    rig.record.actions.clear()
    rig.state()
    rig.graph.wait(lambda: len(rig.record.actions) >= 2, 'actions')
    assert all(np.isfinite(action.values).all() for action in rig.record.actions)


# --- the policy: everything else ----------------------------------------------------------------


def test_disabled_robot_stands_still_until_it_is_enabled(rig: FaultRig) -> None:
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


def test_second_policy_stops_both_until_it_is_gone(rig: FaultRig) -> None:
    rival = rig.another_policy()
    rig.diagnosed(ERROR, 'the action is zero: another policy node acts in this graph')
    rig.state()
    rig.wait_for_zero()
    rig.graph.remove(rival)
    rig.drive()
    rig.diagnosed(OK, 'acting with the adapted policy')


def test_foreign_publisher_of_actions_is_reported(rig: FaultRig) -> None:
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


def test_diagnostics_have_figures(rig: FaultRig) -> None:
    rig.drive()
    figures = values(rig.diagnosed(OK, 'acting'))
    assert float(figures['state_rate_hz']) > 0
    assert float(figures['action_rate_hz']) > 0
    assert float(figures['latency_p99_ms']) >= float(figures['latency_median_ms']) > 0
    assert float(figures['adapt_last_ms']) > 0
    assert figures['adaptations_pending'] == '0'
    assert figures['adapt_engine'] == 'kernels'


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


# --- the policy: the goal node vanishes ---------------------------------------------------------


def test_goal_that_is_not_repeated_is_dropped_until_it_comes_again(make_rig) -> None:
    rig = make_rig()
    rig.state()
    rig.goal(lease_s=0.5)
    rig.wait_for_zero()
    rig.diagnosed(ERROR, 'the action is zero: goal 1 was not repeated for 0.5 s and is dropped')
    assert rig.record.actions[-1].query_id == 0
    rig.goal(lease_s=0.0)
    rig.drive()
    rig.diagnosed(OK, 'acting with the adapted policy')


def test_repeated_goal_is_the_same_goal(make_rig) -> None:
    rig = make_rig()
    nowhere = Point(x=math.nan, y=math.nan)  # of a robot without a position
    for _ in range(5):
        rig.goal(lease_s=5.0, position=nowhere)
        rig.drive()
    rig.graph.wait(lambda: rig.record.reports, 'the adaptation')
    rig.graph.wait_for(0.3)
    assert [report.query_id for report in rig.record.reports] == [1]
    rig.goal(
        lease_s=5.0, goal=(19.0, 20.0), position=nowhere
    )  # the same number, of a goal node that began anew
    rig.graph.wait(lambda: len(rig.record.reports) == 2, 'the second adaptation')


# --- the policy: simulated time -----------------------------------------------------------------


@pytest.fixture
def sim_rig(make_rig) -> FaultRig:
    """Simulated time, which the test makes; the robot has answered the first steps."""
    rig = make_rig(use_sim_time=True, warn_missed_deadlines=0, state_timeout_s=1.0)
    rig.goal()
    rig.play_clock()
    for _ in range(5):
        rig.answered_state()
    return rig


def test_simulator_that_vanishes_takes_the_time_with_it(sim_rig: FaultRig) -> None:
    sim_rig.wait_for_zero()
    sim_rig.diagnosed(ERROR, 'the action is zero: no state for ', fresh=False)
    sim_rig.drive()


@pytest.mark.parametrize('now_s', [5.0, 1e6, None], ids=['back', 'ahead', 'stopped'])
def test_robot_is_driven_whatever_the_clock_does(sim_rig: FaultRig, now_s: float | None) -> None:
    clock = sim_rig._clock
    clock.publish(Clock(clock=to_time(10**11)))
    sim_rig.graph.wait(lambda: sim_rig.node.get_clock().now().nanoseconds == 10**11, 'the time')
    sim_rig._clock = None  # the states go on alone
    if now_s is not None:
        clock.publish(Clock(clock=to_time(round(now_s * 1e9))))
    sim_rig.drive()
    sim_rig.wait_for_zero()  # by the steady clock, as nothing else goes on
    sim_rig.drive()


def test_paused_simulator_is_no_fault(sim_rig: FaultRig) -> None:
    def acts() -> bool:
        sim_rig.state(step=sim_rig._step)
        return any(
            status.message == 'acting with the adapted policy'
            for array in sim_rig.diagnostics[-1:]
            for status in array.status
        )

    sim_rig.graph.wait(acts, 'the adapted policy')
    sim_rig.record.actions.clear()
    sim_rig.diagnostics.clear()
    for _ in range(20):  # twice as long as the timeout
        sim_rig.state(step=sim_rig._step)
        sim_rig.graph.wait_for(0.1)
    sim_rig.graph.wait(lambda: len(sim_rig.record.actions) >= 10, 'actions')
    assert all(any(action.values) for action in sim_rig.record.actions)
    statuses = [status for array in sim_rig.diagnostics for status in array.status]
    assert {status.message for status in statuses} == {'acting with the adapted policy'}
    assert {values(status)['missed_deadlines'] for status in statuses} == {'0'}


def test_steps_without_an_action_are_missed_deadlines(sim_rig: FaultRig) -> None:
    sim_rig._step += 3  # the policy stalls meanwhile
    sim_rig.answered_state()
    status = sim_rig.diagnosed(WARN, '3 deadlines missed in the last minute', fresh=False)
    assert values(status)['missed_deadlines'] == '3'
