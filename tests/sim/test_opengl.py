"""Pictures without a display."""

import os
import sys

import mujoco
import numpy as np
import pytest
from sim_bridge import make_simulator, opengl, SimulatorError

VARIABLES = ('MUJOCO_GL', 'DISPLAY', 'WAYLAND_DISPLAY')


@pytest.fixture
def headless(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process on Linux, without a display and a choice, that has not imported MuJoCo yet."""
    for name in VARIABLES:
        monkeypatch.setenv(name, '')  # so that the old value comes back after the test
        monkeypatch.delenv(name)
    monkeypatch.setattr(sys, 'platform', 'linux')
    monkeypatch.delitem(sys.modules, 'mujoco')


def have_libraries(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    monkeypatch.setattr(
        opengl.ctypes.util, 'find_library', lambda name: name if name in names else None
    )


def choice() -> dict[str, str]:
    opengl.choose_opengl_library()
    return {name: os.environ[name] for name in VARIABLES if name in os.environ}


@pytest.mark.usefixtures('headless')
@pytest.mark.parametrize(
    ('libraries', 'expected'),
    [
        (('OSMesa', 'EGL'), {'MUJOCO_GL': 'egl'}),
        (('OSMesa',), {'MUJOCO_GL': 'osmesa'}),
        ((), {}),
    ],
)
def test_best_library_that_is_there_is_chosen(
    monkeypatch: pytest.MonkeyPatch, libraries: tuple[str, ...], expected: dict[str, str]
) -> None:
    have_libraries(monkeypatch, *libraries)
    assert choice() == expected


@pytest.mark.usefixtures('headless')
@pytest.mark.parametrize('given', [{'MUJOCO_GL': 'glfw'}, {'DISPLAY': ':0'}])
def test_a_choice_or_a_display_is_kept(
    monkeypatch: pytest.MonkeyPatch, given: dict[str, str]
) -> None:
    have_libraries(monkeypatch, 'EGL')
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    assert choice() == given


@pytest.mark.usefixtures('headless')
def test_nothing_is_chosen_once_mujoco_has_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    have_libraries(monkeypatch, 'EGL')
    monkeypatch.setitem(sys.modules, 'mujoco', mujoco)
    assert choice() == {}


@pytest.mark.mujoco
@pytest.mark.parametrize(
    'name', ['pointmaze-medium-v0', 'PointMaze_Medium-v3', 'AntMaze_Medium_Diverse_G-v5']
)
def test_picture_shows_the_walls_and_the_robot_moving(name: str) -> None:
    with make_simulator(name) as simulator:
        start, goal = simulator.tasks[1].start_xy, simulator.tasks[1].goal_xy
        simulator.reset_free(seed=0, start_xy=start)
        try:
            first = simulator.render()
        except SimulatorError as error:
            pytest.skip(f'no OpenGL library on this machine: {error}')
        assert first.shape == (200, 200, 3)
        assert first.dtype == np.uint8
        assert first.std() > 10
        simulator.reset_free(seed=0, start_xy=goal)
        assert (simulator.render() != first).any()


@pytest.mark.mujoco
@pytest.mark.parametrize('error', [mujoco.FatalError('no context'), ImportError('no EGL')])
def test_failure_to_draw_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    with make_simulator('pointmaze-medium-v0') as simulator:
        simulator.reset(task_id=1)
        monkeypatch.setattr(mujoco, 'Renderer', fail)
        with pytest.raises(SimulatorError, match=r'install EGL or OSMesa.*set MUJOCO_GL'):
            simulator.render()
