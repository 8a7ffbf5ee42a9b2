"""Where the humanoid learns to walk: rewards, falls, directions, and going on after a stop."""

import math

import numpy as np
import pytest
from sim_bridge.controllers.humanoid_ground import (
    Course,
    EPISODE_STEPS,
    GOAL_TOLERANCE_M,
    HumanoidGround,
)
from sim_bridge.controllers.humanoid_reward import walking_reward

pytestmark = pytest.mark.mujoco


def ground(course: Course, seed: int = 0) -> HumanoidGround:
    return HumanoidGround(course, np.random.default_rng(seed))


def reward(
    head: float = 1.35,
    vertical: float = 1.0,
    velocity: tuple[float, float] = (0.0, 0.0),
    facing: float = 0.0,
    action: float = 0.0,
) -> float:
    observation = np.zeros((1, 69))
    observation[0, 23], observation[0, 38], observation[0, 39:41] = head, vertical, velocity
    direction = np.array([[0.0, 1.0]])
    return walking_reward(
        observation, np.array([facing]), direction, np.full((1, 21), action)
    ).item()


def test_reward_is_the_formula_worked_out_by_hand() -> None:
    assert reward() == pytest.approx(0.4 * 0.25)  # stands
    assert reward(velocity=(0.0, 0.75)) == pytest.approx(0.4 * (0.25 + 0.75))
    assert reward(velocity=(0.0, 1.5), facing=1.0) == pytest.approx(0.4 * (0.25 + 1.5 + 0.1))
    # No more for 1.6 m/s than for 1.5; at 2.6 m/s 0.6 less.
    assert reward(velocity=(0.0, 1.6)) == pytest.approx(0.4 * 1.75)
    assert reward(velocity=(0.0, 2.6)) == pytest.approx(0.4 * (1.75 - 0.6))
    assert reward(velocity=(0.0, -9.0)) == pytest.approx(0.4 * (0.25 - 0.75))  # backwards
    assert reward(velocity=(-0.5, 0.0)) == pytest.approx(0.4 * (0.25 - 0.05))  # sideways
    assert reward(velocity=(9.0, 0.0)) == pytest.approx(0.4 * (0.25 - 0.2))
    assert reward(action=-0.5) == pytest.approx(0.4 * (0.25 - 0.0125))
    # Head at 0.725 m: half the height, a quarter of its square, and walking counts nothing.
    assert reward(head=0.725, velocity=(0.0, 1.5)) == pytest.approx(0.4 * (0.05 + 0.0375))
    assert reward(head=0.725, vertical=-1.0) == pytest.approx(0.4 * 0.05)
    assert reward(head=1.075, velocity=(0.0, 1.5)) == pytest.approx(
        0.4 * (0.078 + 0.15 * 0.78**2 + 0.5 * 1.5)
    )


def test_standing_is_worth_less_than_a_fifth_of_walking() -> None:
    assert reward(facing=1.0) < 0.2 * reward(velocity=(0.0, 1.5), facing=1.0)


def test_limp_humanoids_fall_once_and_stand_up_again_at_once() -> None:
    ours = ground(Course(floors=3))
    rng = np.random.default_rng(0)
    for _ in range(200):
        step = ours.step(np.zeros((3, 21)), rng)
        assert not (step.fallen & ~step.cut).any()
        np.testing.assert_array_equal(step.next_inputs[:, 21] < 0.9, step.fallen)
        assert (ours.inputs[:, 21] >= 0.9).all()
        np.testing.assert_allclose(ours.inputs[step.fallen, 21], 1.49, atol=0.01)
        np.testing.assert_array_equal(ours.inputs[~step.cut], step.next_inputs[~step.cut])
        if step.fallen.any():
            break
    else:
        pytest.fail('nobody fell')


def test_episode_that_is_too_long_is_cut_but_not_as_a_fall(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('sim_bridge.controllers.humanoid_ground.EPISODE_STEPS', 4)
    ours = ground(Course(floors=2, p_turning=0.0))
    rng = np.random.default_rng(0)
    steps = [ours.step(np.zeros((2, 21)), rng) for _ in range(8)]
    assert [step.cut.tolist() for step in steps] == 2 * [*3 * [[False] * 2], [True] * 2]
    assert not any(step.fallen.any() for step in steps)
    assert EPISODE_STEPS == 1000


def directions(inputs: np.ndarray) -> np.ndarray:
    """Angle of the direction against the heading of an upright humanoid."""
    return np.arctan2(inputs[:, 65], inputs[:, 64])


def test_first_direction_is_within_the_asked_angle_of_the_heading() -> None:
    ours = ground(Course(floors=40, turn_rad=(0.6, math.pi), turn_steps=1000))
    angles = np.abs(directions(ours.inputs))
    assert 0.3 < angles.max() <= 0.6 + 1e-6


def test_direction_changes_by_the_asked_angle_and_cuts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('sim_bridge.controllers.humanoid_ground._SWITCH_STEPS', (3, 4))
    ours = ground(Course(floors=20, turn_rad=(0.5, 0.5), p_turning=1.0))
    rng = np.random.default_rng(0)
    steps = [ours.step(np.zeros((20, 21)), rng) for _ in range(3)]
    assert [step.cut.all() for step in steps] == [False, False, True]
    change = directions(ours.inputs) - directions(steps[-1].next_inputs)
    change = (change + math.pi) % (2 * math.pi) - math.pi
    assert 0.2 < np.abs(change).max() < 0.51
    np.testing.assert_array_equal(ours.inputs[:, :64], steps[-1].next_inputs[:, :64])


def test_noise_and_pushes_reach_whom_they_should() -> None:
    def heads(course: Course, steps: int) -> np.ndarray:
        ours = ground(course)
        rng = np.random.default_rng(3)
        for _ in range(steps):
            inputs = ours.step(np.zeros((4, 21)), rng).next_inputs
        return inputs

    calm = heads(Course(floors=4), 3)
    noisy = heads(Course(floors=4, noisy=0.5), 3)
    same = (noisy == calm).all(axis=1)
    assert same.tolist() == [True, False, True, False]
    pushed = heads(Course(floors=4, p_push=1.0), 1)
    change = np.linalg.norm(pushed[:, 37:40] - heads(Course(floors=4), 1)[:, 37:40], axis=1)
    assert (change > 0.01).all()
    assert (change < math.hypot(0.5, 0.5)).all()


def test_in_a_maze_the_direction_leads_through_the_next_cell() -> None:
    ours = ground(Course(floors=0, mazes=('medium', 'large')))
    rng = np.random.default_rng(0)
    for _ in range(3):
        ours.step(np.zeros((2, 21)), rng)
        for index, maze in enumerate(ours._maps):
            assert maze is not None
            x, y = ours._envs[index].data.qpos[:2]
            aim = maze.waypoint(maze.cell(x, y), tuple(ours._goals[index]))
            angle = math.atan2(aim[1] - y, aim[0] - x)
            assert ours._angles[index] == pytest.approx(angle)


def test_reached_goal_and_entered_cell_cut_in_a_maze() -> None:
    ours = ground(Course(floors=0, mazes=('medium',)))
    env, maze = ours._envs[0], ours._maps[0]
    assert maze is not None
    rng = np.random.default_rng(0)
    actions = np.zeros((1, 21))
    ours._goals[0] = maze.center(6, 6)
    assert not ours.step(actions, rng).cut[0]
    qpos = env.data.qpos.copy()
    qpos[:2] = maze.center(6, 5)
    env.set_state(qpos, env.data.qvel.copy())
    step = ours.step(actions, rng)
    assert step.cut[0]
    assert not step.fallen[0]
    assert ours._cells[0].tolist() == [6, 5]
    assert not ours.step(actions, rng).cut[0]
    qpos[:2] = np.add(maze.center(6, 6), (0.5 * GOAL_TOLERANCE_M, 0.0))
    env.set_state(qpos, env.data.qvel.copy())
    assert ours.step(actions, rng).cut[0]
    assert ours._goals[0].tolist() != list(maze.center(6, 6))


def test_restored_ground_goes_on_bit_by_bit() -> None:
    course = Course(floors=2, mazes=('medium',), p_turning=1.0, noisy=0.5, p_push=0.2)
    ours, theirs = ground(course), ground(course, seed=9)
    actions = np.random.default_rng(0).uniform(-1, 1, (60, 3, 21))
    for number in range(30):
        ours.step(actions[number], np.random.default_rng(number))
    theirs.load_arrays({name: array.copy() for name, array in ours.arrays().items()})
    np.testing.assert_array_equal(theirs.inputs, ours.inputs)
    for number in range(30, 60):
        ours.step(actions[number], np.random.default_rng(number))
        theirs.step(actions[number], np.random.default_rng(number))
        np.testing.assert_array_equal(theirs.inputs, ours.inputs)
