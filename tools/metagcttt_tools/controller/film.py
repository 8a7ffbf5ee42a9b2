"""Film a walking robot, with an arrow along the direction it follows."""

from pathlib import Path

import numpy as np
from sim_bridge.controllers import LearnedFollower
from sim_bridge.controllers.walk import QUARTER_TURNS_RAD, Walk, walk_along
from sim_bridge.mazes.ogbench import open_floor

from metagcttt_tools.common.film import add_shape, Picture, renderer, write_film

FRAMES_PER_S = 10
SIZE_PX = 240, 320
_ARROW_M = 0.4, 1.3
_ARROW_RGBA = 0.96, 0.26, 0.33, 1.0


def film(follower: LearnedFollower, path: Path, seed: int, duration_s: float = 10.0) -> None:
    """Write a GIF of a walk that turns by a right angle now and then."""
    walk = walk_along(follower, np.array([1.0, 0.0]), duration_s, seed, QUARTER_TURNS_RAD)
    write_film(path, draw_walk(follower.robot, walk), 1000 // FRAMES_PER_S)


def draw_walk(robot: str, walk: Walk) -> list[Picture]:
    """Pictures of a walk, `FRAMES_PER_S` a second, each of shape (height, width, 3).

    Raises:
        SimulatorError: If this machine cannot draw without a display; says what to set.
    """
    environment = open_floor(robot)
    import mujoco

    camera = mujoco.MjvCamera()
    camera.distance, camera.elevation, camera.azimuth = 3.6, -25.0, 60.0
    pictures = []
    stride = max(1, round(1 / (FRAMES_PER_S * walk.period_s)))
    with renderer(environment.model, SIZE_PX) as draw:
        for step in range(0, len(walk.directions), stride):
            environment.set_state(walk.qpos[step], np.zeros(environment.model.nv))
            camera.lookat[:] = (*walk.path[step], 0.7)
            draw.update_scene(environment.data, camera)
            start, end = (
                np.array([*(walk.path[step] + reach_m * walk.directions[step]), 0.05])
                for reach_m in _ARROW_M
            )
            kind = mujoco.mjtGeom.mjGEOM_ARROW
            arrow = add_shape(draw.scene, kind, _ARROW_RGBA, (0, 0, 0), (0, 0, 0))
            mujoco.mjv_connector(arrow, kind, 0.04, start, end)
            pictures.append(draw.render().copy())
    environment.close()
    return pictures
