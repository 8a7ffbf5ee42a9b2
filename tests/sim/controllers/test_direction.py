"""Controllers that follow directions, by robot."""

from pathlib import Path

import numpy as np
import pytest
from sim_bridge import describe_environment, make_simulator
from sim_bridge.controllers import ControllerError, LearnedFollower, make_direction_follower


def untrained(robot: str, obs_dim: int, act_dim: int) -> LearnedFollower:
    zeros = np.zeros((obs_dim, act_dim), np.float32)
    return LearnedFollower(robot, (zeros,), (zeros[0],))


def test_point_moves_in_the_direction_itself() -> None:
    follower = make_direction_follower(describe_environment('pointmaze-giant-v0').spec)
    direction = np.array([0.6, -0.8])
    np.testing.assert_array_equal(follower.act(np.zeros(2), direction, np.zeros(2)), direction)


@pytest.mark.mujoco
def test_pushed_point_reaches_its_speed_along_the_direction_and_keeps_it() -> None:
    with make_simulator('PointMaze_Open-v3') as simulator:
        follower = make_direction_follower(simulator.spec)
        observation = simulator.reset_free(seed=0, start_xy=(-2.0, 0.0))
        for _ in range(80):
            action = follower.act(observation, np.array([1.0, 0.0]), simulator.qpos)
            observation = simulator.step(np.clip(action, -1, 1)).observation
        assert simulator.position[0] > 0
        np.testing.assert_allclose(observation[2:], (3.0, 0.0), atol=0.2)


def test_robot_without_a_controller_is_refused_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('sim_bridge.controllers.direction.BUNDLED', tmp_path)
    spec = describe_environment('humanoidmaze-medium-v0').spec
    with pytest.raises(
        ControllerError,
        match=r'humanoidmaze-medium-v0: .*learned direction controller .69 observation and 21 '
        'action.*controller train-humanoid.*published datasets',
    ):
        make_direction_follower(spec)


def test_given_controller_is_used(tmp_path: Path) -> None:
    untrained('humanoid', 67, 21).save(tmp_path)
    spec = describe_environment('humanoidmaze-medium-v0').spec
    follower = make_direction_follower(spec, tmp_path)
    assert follower.act(np.zeros(69), np.array([1.0, 0.0]), np.ones(28)).shape == (21,)


@pytest.mark.parametrize(
    ('environment', 'robot', 'dims', 'message'),
    [
        ('antmaze-medium-v0', 'humanoid', (29, 8), 'drives humanoid, antmaze-medium-v0 needs ant'),
        ('antmaze-medium-v0', 'ant', (31, 8), 'for 31 observation and 8 action dimensions, .* 29'),
        ('pointmaze-medium-v0', 'ant', (2, 2), 'without a learned controller'),
        ('AntMaze_Medium-v5', 'ant', (107, 8), 'no controller for its robot'),
    ],
)
def test_controller_of_another_robot_is_refused(
    tmp_path: Path, environment: str, robot: str, dims: tuple[int, int], message: str
) -> None:
    untrained(robot, *dims).save(tmp_path)
    with pytest.raises(ControllerError, match=message):
        make_direction_follower(describe_environment(environment).spec, tmp_path)
