"""The ant's symmetry against the physics, and the controller that comes with the package."""

import gymnasium
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import ogbench.online_locomotion  # registers the environments  # noqa: F401
import pytest
from sim_bridge import describe_environment
from sim_bridge.controllers import AntFollower, make_direction_follower
from sim_bridge.controllers.ant import turn_action, turn_inputs
from sim_bridge.controllers.walk import walk_along

QUARTER = np.array([[0.0, 1.0], [-1.0, 0.0]])  # clockwise


@pytest.mark.mujoco
@pytest.mark.parametrize('turns', [1, 2, 3])
def test_turned_ant_under_a_turned_action_moves_as_before_but_turned(turns: int) -> None:
    environment = gymnasium.make('online-ant-v0', disable_env_checker=True).unwrapped
    rng = np.random.default_rng(turns)

    def after(state: np.ndarray, action: np.ndarray) -> np.ndarray:
        environment.set_state(np.concatenate([(0.0, 0.0), state[:13]]), state[13:27])
        environment.data.qacc_warmstart[:] = 0
        for _ in range(3):
            state, *_ = environment.step(action)
        return np.concatenate([state, environment.data.qpos[:2]])  # where a direction stands

    state, _ = environment.reset(seed=turns)
    for _ in range(12):
        state, *_ = environment.step(rng.uniform(-1, 1, 8))
    action = rng.uniform(-1, 1, 8)
    turned_state = turn_inputs(np.concatenate([state, (0.0, 0.0)]), turns)[:27]
    moved = after(state, action)
    np.testing.assert_allclose(
        after(turned_state, turn_action(action, turns)), turn_inputs(moved, turns), atol=1e-9
    )
    assert np.linalg.norm(moved[:2]) > 0


def test_four_quarters_are_none_and_turns_add_up() -> None:
    inputs, action = np.arange(1.0, 30.0), np.arange(1.0, 9.0)
    for turn, values in ((turn_inputs, inputs), (turn_action, action)):
        np.testing.assert_array_equal(turn(values, 4), values)
        np.testing.assert_array_equal(turn(turn(values, 3), 2), turn(values, 1))
        np.testing.assert_array_equal(turn(turn(values, 2), -2), values)
    np.testing.assert_array_equal(turn_inputs(inputs, 1)[27:], QUARTER @ inputs[27:])


@given(st.floats(-np.pi, np.pi), st.integers(0, 3), st.integers(0, 1000))
def test_follower_is_as_symmetric_as_the_ant(angle: float, turns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(29, 8)).astype(np.float32)
    follower = AntFollower('ant', (weights,), (weights[0],))
    inputs = np.concatenate([rng.normal(size=27), (np.cos(angle), np.sin(angle))])
    turned = turn_inputs(inputs, turns)

    def act(own_and_direction: np.ndarray) -> np.ndarray:
        observation = np.concatenate([rng.normal(size=2), own_and_direction[:27]])
        return follower.act(observation, own_and_direction[27:], np.zeros(15))

    np.testing.assert_allclose(act(turned), turn_action(act(inputs), turns), atol=1e-6)


def test_direction_inside_the_learned_quarter_goes_to_the_network_as_it_is() -> None:
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(29, 8)).astype(np.float32)
    follower = AntFollower('ant', (weights,), (weights[0],))
    observation = rng.normal(size=29)
    for degrees, same in ((-22, True), (0, True), (67, True), (68, False), (-23, False)):
        direction = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        plain = follower.network(np.concatenate([observation[2:], direction]))
        assert np.array_equal(follower.act(observation, direction, np.zeros(15)), plain) == same


@pytest.mark.mujoco
def test_controller_of_the_package_walks_a_cell_in_forty_steps_without_falling() -> None:
    follower = make_direction_follower(describe_environment('antmaze-medium-v0').spec)
    assert isinstance(follower, AntFollower)
    for angle in np.arange(8) * np.pi / 4:
        walk = walk_along(follower, np.array([np.cos(angle), np.sin(angle)]), 20.0, seed=7)
        assert walk.path.shape == (201, 2)
        assert walk.falls == 0
        assert walk.speed * walk.period_s * 40 > 4.0
        assert walk.distance_m == pytest.approx(walk.speed * 20.0)


# Signed places, from 1, that each number comes from in a quarter turn: the matrices once more.
INPUTS = (1, 2, 4, -3, 5, 8, -9, 10, 11, 12, -13, 6, 7, 15, -14, 16, 18, -17, 19)
INPUTS += (22, -23, 24, 25, 26, -27, 20, 21, 29, -28)
ACTION = (3, 4, 5, -6, 7, 8, 1, -2)


@pytest.mark.parametrize(('turn', 'table'), [(turn_inputs, INPUTS), (turn_action, ACTION)])
def test_turns_are_signed_permutations(turn, table):
    values = np.random.default_rng(0).normal(size=len(table))
    expected = values
    for turns in range(6):
        np.testing.assert_array_equal(turn(values, turns), expected)
        expected = np.array([np.sign(place) * expected[abs(place) - 1] for place in table])
