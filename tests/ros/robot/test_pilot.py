"""Commands are the policy's while all is well, and otherwise what the contract falls back on."""

from metagcttt.robot.pilot import Pilot
import numpy as np
import pytest
from tests.core.robot.messages import ARM, contract

STEP = 10**8
FORWARD = np.array([1.0, 0.5])


@pytest.fixture
def pilot() -> Pilot:
    pilot = Pilot(contract())
    pilot.saw_observation(1, np.zeros(4), 0)
    return pilot


def sent(pilot: Pilot, now_ns: int, *, due: bool = False) -> list[list[float]]:
    return [command.tolist() for _, command in pilot.commands(now_ns, due=due)]


def case(pilot: Pilot, now_ns: int) -> str:
    return pilot.situation(contract().act[0], now_ns).case


def test_action_becomes_a_command(pilot: Pilot) -> None:
    assert pilot.take_action(1, 7, FORWARD) == ''
    assert sent(pilot, STEP) == [[pytest.approx(0.1), 1.0]]  # 1 m/s within 1 m/s^2


@pytest.mark.parametrize(
    ('prepare', 'expected'),
    [
        (lambda pilot: None, 'silent'),
        (lambda pilot: pilot.take_action(1, 0, FORWARD), 'no_goal'),
        (lambda pilot: pilot.take_action(1, 7, FORWARD, withheld=True), 'silent'),
        (lambda pilot: pilot.take_action(1, 7, FORWARD), ''),
    ],
)
def test_fallback_has_its_case(pilot: Pilot, prepare, expected: str) -> None:
    prepare(pilot)
    assert case(pilot, STEP) == expected
    assert (sent(pilot, STEP) == [[0.0, 0.0]]) == bool(expected)
    pilot.fault = 'late'
    assert case(pilot, STEP) == 'fault'
    pilot.stopped = 'stopped'
    assert case(pilot, STEP) == 'stop'
    assert sent(pilot, STEP) == [[0.0, 0.0]]


def test_zero_action_is_an_action(pilot: Pilot) -> None:
    pilot.take_action(1, 7, np.zeros(2))
    assert case(pilot, STEP) == ''
    assert sent(pilot, STEP) == [[pytest.approx(0.1), 0.0]]  # the middle of -0.5 to 1


def test_action_is_as_old_as_the_observation_it_answers(pilot: Pilot) -> None:
    pilot.take_action(1, 7, FORWARD)
    assert case(pilot, 5 * STEP) == ''
    assert case(pilot, 5 * STEP + 1) == 'silent'
    assert sent(pilot, 5 * STEP + 1) == [[0.0, 0.0]]


@pytest.mark.parametrize(
    ('step', 'values', 'reason'),
    [
        (2, FORWARD, 'the action answers step 2, which was not observed lately'),
        (1, np.array([1.0, np.nan]), 'the action is not finite'),
        (1, np.zeros(3), 'the action has 3 values, 2 are needed'),
    ],
)
def test_unusable_action_is_refused_and_the_one_before_stays(
    pilot: Pilot, step: int, values: np.ndarray, reason: str
) -> None:
    pilot.take_action(1, 7, FORWARD)
    assert pilot.take_action(step, 7, values).startswith(reason)
    assert case(pilot, STEP) == ''


def test_action_for_an_older_observation_is_refused(pilot: Pilot) -> None:
    pilot.saw_observation(2, np.zeros(4), STEP)
    pilot.take_action(2, 7, FORWARD)
    assert 'came after that for a newer one' in pilot.take_action(1, 7, FORWARD)


def test_command_is_repeated_only_when_an_action_is_missing(pilot: Pilot) -> None:
    pilot.take_action(1, 7, FORWARD)
    assert len(sent(pilot, STEP // 10)) == 1
    assert sent(pilot, STEP, due=True) == []  # the answer is under way
    assert len(sent(pilot, 2 * STEP, due=True)) == 1


def test_commands_are_in_reach_by_the_clock_of_the_robot(pilot: Pilot) -> None:
    pilot.take_action(1, 7, FORWARD)
    commands = [
        pilot.commands(now_ns, due=False, robot_ns=robot_ns)[0][1].tolist()
        for now_ns, robot_ns in ((STEP, STEP), (STEP + 1, 2 * STEP), (2 * STEP, 2 * STEP))
    ]
    assert commands[0] == pytest.approx([0.1, 1.0])  # 1 m/s^2, and no limit
    assert commands[1] == commands[2] == pytest.approx([0.2, 1.0])  # then its time stands still


def test_another_action_for_the_same_observation_only_repeats_the_answer(pilot: Pilot) -> None:
    repeats = []
    for query, withheld in ((7, True), (7, False), (7, False), (8, False), (8, False)):
        pilot.take_action(1, query, FORWARD, withheld=withheld)
        repeats.append(pilot.repeats)
    pilot.saw_observation(2, np.zeros(4), STEP)
    pilot.take_action(2, 8, FORWARD)
    assert [*repeats, pilot.repeats] == [False, False, True, False, True, False]


def test_observations_are_not_remembered_for_ever(pilot: Pilot) -> None:
    for step in range(2, 1002):
        pilot.saw_observation(step, np.zeros(4), step * STEP)
    assert 'not observed lately' in pilot.take_action(1, 7, FORWARD)
    assert pilot.take_action(2, 7, FORWARD) == ''


def test_farewell_is_that_of_the_contract(pilot: Pilot) -> None:
    assert [command.tolist() for _, command in pilot.farewell(0)] == [[0.0, 0.0]]
    assert Pilot(contract(ARM)).farewell(0) == []
