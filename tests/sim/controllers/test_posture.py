"""Falls, counted from the torso's quaternion."""

import math

import numpy as np
import pytest
from sim_bridge.controllers.posture import count_falls, has_fallen, uprightness
from sim_bridge.mazes.ogbench import open_floor


def pose(lean_rad: float, yaw_rad: float = 0.0) -> np.ndarray:
    """A pose that leans about x, after a turn about z: quaternion product z-turn * x-lean."""
    cx, sx = math.cos(lean_rad / 2), math.sin(lean_rad / 2)
    cz, sz = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return np.array([5.0, -3.0, 0.6, cz * cx, cz * sx, sz * sx, sz * cx, 0.1])


@pytest.mark.parametrize('lean_deg', [0, 30, 60, 90, 135, 180])
def test_uprightness_is_the_cosine_of_the_lean_whatever_the_heading(lean_deg: int) -> None:
    lean = math.radians(lean_deg)
    poses = np.array([pose(lean, yaw) for yaw in (0.0, 1.0, -2.5)])
    np.testing.assert_allclose(uprightness(poses), math.cos(lean), atol=1e-12)


def test_each_fall_counts_once_and_getting_up_between_two_makes_two() -> None:
    up, down = pose(0.2), pose(2.0)
    assert count_falls(np.array([up, up, down, down, up, down])) == 2
    assert count_falls(np.array([down, up, up])) == 1
    assert count_falls(np.array([up, up])) == 0


def test_point_cannot_fall() -> None:
    assert count_falls(np.zeros((4, 2))) == 0


def test_humanoid_has_fallen_when_its_head_is_low() -> None:
    qpos = np.zeros((4, 28))
    qpos[:, 3] = 1.0
    qpos[:, 2] = 1.3, 0.72, 0.70, 1.0
    qpos[3, 3:7] = np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0  # leans by 90 degrees, yet high up
    np.testing.assert_array_equal(has_fallen(qpos), [False, False, True, False])
    assert count_falls(qpos) == 1


@pytest.mark.mujoco
def test_head_is_where_the_physics_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = open_floor('humanoid')
    for seed in range(5):
        environment.reset(seed=seed)
        head = environment.data.body('head').xpos[2]
        for limit, fallen in ((head + 1e-9, True), (head - 1e-9, False)):
            monkeypatch.setattr('sim_bridge.controllers.posture.FALLEN_HEAD_M', limit)
            assert has_fallen(environment.data.qpos) == fallen
