"""The humanoid's policy inputs and mirror symmetry against the physics, and its controller."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from sim_bridge import describe_environment
from sim_bridge.controllers import HumanoidFollower, LearnedFollower, make_direction_follower
from sim_bridge.controllers.humanoid import (
    ACTION_SIGNS,
    ACTION_SOURCES,
    INPUT_SIGNS,
    INPUT_SOURCES,
    JOINTS,
    mirror_action,
    mirror_inputs,
    MOTORS,
    policy_inputs,
)
from sim_bridge.controllers.rising import RisingHumanoid
from sim_bridge.controllers.walk import QUARTER_TURNS_RAD, walk_along, walk_to_goal
from sim_bridge.mazes.ogbench import OGBenchMaze, open_floor, standing_pose

pytestmark = pytest.mark.mujoco
DIRECTION = np.array([0.6, 0.8])


@pytest.fixture
def floor() -> Iterator[Any]:
    environment = open_floor('humanoid')
    environment.reset(seed=0)
    yield environment
    environment.close()


def shake(environment: Any, steps: int = 20) -> None:
    """Leave the humanoid in some pose and motion in mid-fall."""
    rng = np.random.default_rng(0)
    environment.set_state(standing_pose((1.0, 2.0), rng)[0], np.zeros(27))
    for _ in range(steps):
        environment.do_simulation(rng.uniform(-1, 1, 21), environment.frame_skip)


def inputs_of(environment: Any, direction: np.ndarray = DIRECTION) -> np.ndarray:
    return policy_inputs(environment.get_ob(), environment.data.qpos[3:7], direction)


def test_joints_and_motors_are_the_models(floor: Any) -> None:
    model = floor.model
    assert tuple(model.joint(number).name for number in range(1, model.njnt)) == JOINTS
    assert tuple(model.actuator(number).name for number in range(model.nu)) == MOTORS


def test_inputs_are_what_the_physics_says_in_the_frame_of_the_torso(floor: Any) -> None:
    shake(floor)
    inputs, data = inputs_of(floor), floor.data
    torso = data.body('torso').xmat.reshape(3, 3)
    assert inputs.shape == (67,)
    np.testing.assert_allclose(inputs[:21], data.qpos[7:].clip(-5, 5))
    np.testing.assert_allclose(inputs[21:25], [data.body('head').xpos[2], *torso[2]])
    for place, limb in enumerate(('left_hand', 'left_foot', 'right_hand', 'right_foot')):
        offset = torso.T @ (data.body(limb).xpos - data.body('torso').xpos)
        np.testing.assert_allclose(inputs[25 + 3 * place :][:3], offset, atol=1e-12)
    velocity = torso.T @ data.sensor('torso_subtreelinvel').data
    np.testing.assert_allclose(inputs[37:40], velocity, atol=1e-12)
    np.testing.assert_allclose(inputs[40:43], (data.qvel[3:6] / 4).clip(-5, 5), atol=1e-12)
    np.testing.assert_allclose(inputs[43:64], (data.qvel[6:] / 10).clip(-5, 5))
    np.testing.assert_allclose(inputs[64:], torso.T @ (*DIRECTION, 0), atol=1e-12)


def test_inputs_do_not_change_when_humanoid_and_direction_turn_together(floor: Any) -> None:
    shake(floor)
    before = inputs_of(floor)
    angle = 1.2
    cos, sin = np.cos(angle), np.sin(angle)
    quaternion = np.empty(4)
    import mujoco

    turn = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    mujoco.mju_mulQuat(quaternion, turn, floor.data.qpos[3:7])
    qpos, qvel = floor.data.qpos.copy(), floor.data.qvel.copy()
    qpos[3:7] = quaternion
    around = np.array([[cos, -sin], [sin, cos]])
    qvel[:2] = around @ qvel[:2]
    floor.set_state(qpos, qvel)
    np.testing.assert_allclose(inputs_of(floor, around @ DIRECTION), before, atol=1e-9)


def test_batch_gives_the_rows_one_by_one() -> None:
    rng = np.random.default_rng(0)
    observations, quaternions = rng.normal(size=(4, 69)), rng.normal(size=(4, 4))
    directions = rng.normal(size=(4, 2))
    rows = [policy_inputs(*row) for row in zip(observations, quaternions, directions, strict=True)]
    np.testing.assert_allclose(policy_inputs(observations, quaternions, directions), rows)


def test_mirror_image_under_the_mirrored_action_moves_as_the_mirror_image(floor: Any) -> None:
    shake(floor)
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1, 1, (10, 21))

    def inputs_under(actions: np.ndarray, direction: np.ndarray) -> np.ndarray:
        floor.data.qacc_warmstart[:] = 0
        seen = [inputs_of(floor, direction)]
        for action in actions:
            floor.do_simulation(action, floor.frame_skip)
            seen.append(inputs_of(floor, direction))
        return np.array(seen)

    qpos, qvel = floor.data.qpos.copy(), floor.data.qvel.copy()
    ours = inputs_under(actions, DIRECTION)
    # The plane of the mirror is x-z: y, and turns about x and z, change their signs.
    qpos[[1, 4, 6]] *= -1
    qvel[[1, 3, 5]] *= -1
    joints, signs = INPUT_SOURCES[:21], INPUT_SIGNS[:21]
    qpos[7:], qvel[6:] = qpos[7:][joints] * signs, qvel[6:][joints] * signs
    floor.set_state(qpos, qvel)
    theirs = inputs_under(mirror_action(actions), DIRECTION * (1, -1))
    np.testing.assert_allclose(theirs, mirror_inputs(ours), atol=1e-9)
    assert np.abs(ours[-1] - ours[0]).max() > 0.1


def test_mirror_of_the_mirror_image_is_the_original() -> None:
    for sources, signs in ((INPUT_SOURCES, INPUT_SIGNS), (ACTION_SOURCES, ACTION_SIGNS)):
        values = np.arange(1.0, 1 + len(sources))
        once = values[sources] * signs
        np.testing.assert_array_equal(once[sources] * signs, values)
        assert not np.array_equal(once, values)


def test_follower_feeds_the_network_what_the_policy_sees(floor: Any) -> None:
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(67, 8)), rng.normal(size=(8, 21))
    follower = HumanoidFollower(
        'humanoid',
        tuple(weight.astype(np.float32) for weight in weights),
        (np.zeros(8, np.float32), np.zeros(21, np.float32)),
        layer_norm=True,
    )
    assert (follower.obs_dim, follower.act_dim) == (69, 21)
    action = follower.act(floor.get_ob(), DIRECTION, floor.data.qpos)
    np.testing.assert_array_equal(action, follower.network(inputs_of(floor)))
    hidden = inputs_of(floor) @ weights[0]
    hidden = np.maximum((hidden - hidden.mean()) / np.sqrt(hidden.var() + 1e-5), 0)
    np.testing.assert_allclose(action, np.tanh(hidden @ weights[1]), atol=1e-5)


@pytest.fixture(scope='module')
def bundled() -> LearnedFollower:
    follower = make_direction_follower(describe_environment('humanoidmaze-medium-v0').spec)
    assert isinstance(follower, RisingHumanoid)
    return follower.walker


def test_controller_of_the_package_walks_and_turns_without_falling(
    bundled: LearnedFollower,
) -> None:
    straight = walk_along(bundled, np.array([0.0, 1.0]), 10.0, seed=7)
    assert straight.qpos.shape == (401, 28)
    assert (straight.falls, straight.duration_s) == (0, pytest.approx(10.0))
    assert straight.speed > 1.2
    turning = walk_along(bundled, np.array([0.0, 1.0]), 10.0, 7, QUARTER_TURNS_RAD, 0.2)
    assert turning.falls == 0
    assert turning.speed > 1.0
    assert len(np.unique(turning.directions.round(6), axis=0)) > 1


def test_controller_of_the_package_reaches_a_goal_in_the_maze(bundled: LearnedFollower) -> None:
    with OGBenchMaze('humanoidmaze-medium-v0') as maze:
        run = walk_to_goal(bundled, maze, task_id=4, seed=0, action_noise=0.2)
    assert run.reached
    assert run.falls == 0
    assert 5 < run.duration_s < 50


def test_walk_counts_falls_and_stands_the_humanoid_up_again() -> None:
    limp = HumanoidFollower(
        'humanoid', (np.zeros((67, 21), np.float32),), (np.zeros(21, np.float32),)
    )
    walk = walk_along(limp, np.array([1.0, 0.0]), 5.0, seed=0)
    assert walk.falls >= 2
    assert walk.qpos[:, 2].max() > 1.2
    with OGBenchMaze('humanoidmaze-medium-v0') as maze:
        run = walk_to_goal(limp, maze, task_id=1, seed=0, action_noise=0.0)
    assert (run.reached, run.falls) == (False, 1)
    assert run.duration_s < 5
