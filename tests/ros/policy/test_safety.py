from metagcttt.policy.decision import State
from metagcttt.policy.safety import Safety
import numpy as np

FINE = State(1, 0, np.zeros(2), ended=False)


def reason(safety: Safety, now_s: float = 0.0, clock_s: float = 0.0, state: State = FINE) -> str:
    return safety.zero_reason(state, now_s=now_s, clock_s=clock_s, timeout_s=0.5)


def test_state_is_stale_by_either_clock() -> None:
    safety = Safety(enabled=True)
    assert reason(safety, now_s=99.0, clock_s=99.0) == ''  # none has come that could be stale
    safety.saw_state(100.0, 7.0)
    assert reason(safety, 100.5, 7.5) == ''
    assert reason(safety, 100.6, 7.0) == 'no state for 0.6 s'  # simulated time stands still
    assert reason(safety, 100.1, 9.0) == 'no state for 2.0 s'  # or runs fast
    assert reason(safety, 100.1, 0.0) == ''  # or begins anew
    safety.saw_state(100.6, 7.0)
    assert reason(safety, 100.6, 7.0) == ''


def test_goal_is_lost_when_its_lease_ends_and_found_with_the_next_message() -> None:
    safety = Safety(enabled=True)
    safety.saw_goal(10.0, lease_s=2.0)
    assert not safety.expire_goal(3, 12.0)
    safety.saw_goal(11.0, lease_s=2.0)
    assert not safety.expire_goal(3, 13.0)
    assert safety.expire_goal(3, 13.1)
    assert reason(safety) == 'goal 3 was not repeated for 2 s and is dropped'
    safety.saw_goal(14.0, lease_s=0.0)
    assert reason(safety) == ''
    assert not safety.expire_goal(3, 10**6)


def test_order_of_the_reasons() -> None:
    safety = Safety(enabled=False)
    safety.rivals.saw(5, 10.0)
    safety.saw_goal(0.0, lease_s=1.0)
    safety.expire_goal(1, 10.0)
    safety.saw_state(0.0, 0.0)
    bad = State(1, 0, np.zeros(0), ended=False, fault='the state has 0 values, 2 are needed')
    found = [reason(safety, 10.0, 10.0, bad)]
    safety.enabled = True
    found.append(reason(safety, 10.0, 10.0, bad))
    found.append(reason(safety, 12.0, 12.0, bad))
    safety.saw_goal(12.0, lease_s=1.0)
    found.append(reason(safety, 12.0, 12.0, bad))
    safety.saw_state(12.0, 12.0)
    found.append(reason(safety, 12.0, 12.0, bad))
    assert found == [
        'disabled by the service enable',
        'another policy node acts in this graph',
        'goal 1 was not repeated for 1 s and is dropped',
        'no state for 12.0 s',
        'the state has 0 values, 2 are needed',
    ]


def test_robot_rests_from_a_state_out_of_order_to_the_next_in_order() -> None:
    safety = Safety(enabled=True)
    safety.saw_state(1.0, 1.0, 'state 0 of episode 1 came after state 5 of episode 1')
    assert reason(safety, 1.0, 1.0).startswith('state 0 of episode 1 came after')
    safety.saw_state(1.1, 1.1)
    assert reason(safety, 1.1, 1.1) == ''
