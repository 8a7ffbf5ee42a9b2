"""Film a walking robot, with an arrow along the direction it follows."""

import io
from pathlib import Path

import numpy as np
from sim_bridge.controllers import LearnedFollower
from sim_bridge.controllers.walk import QUARTER_TURNS_RAD, Walk, walk_along
from sim_bridge.mazes.ogbench import open_floor
from sim_bridge.opengl import rendering_help
from sim_bridge.simulator import SimulatorError

FRAMES_PER_S = 10
SIZE_PX = 240, 320
_ARROW_M = 0.4, 1.3
_ARROW_RGBA = np.array([0.96, 0.26, 0.33, 1.0], np.float32)


def film(follower: LearnedFollower, path: Path, seed: int, duration_s: float = 10.0) -> None:
    """Write a GIF of a walk that turns by a right angle now and then."""
    from PIL import Image

    from metagcttt_tools.common.plots import write_gif

    walk = walk_along(follower, np.array([1.0, 0.0]), duration_s, seed, QUARTER_TURNS_RAD)
    images = [Image.fromarray(frame) for frame in draw_walk(follower.robot, walk)]
    # One palette, that keeps the colour of the small arrow too: colours shall not flicker.
    palette = images[0].quantize(64, Image.Quantize.MAXCOVERAGE)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    content = io.BytesIO()
    duration_ms = 1000 // FRAMES_PER_S
    frames[0].save(
        content, 'GIF', save_all=True, append_images=frames[1:], duration=duration_ms, loop=0
    )
    write_gif(path, content.getvalue())


def draw_walk(robot: str, walk: Walk) -> list[np.ndarray]:
    """Pictures of a walk, `FRAMES_PER_S` a second, each of shape (height, width, 3).

    Raises:
        SimulatorError: If this machine cannot draw without a display; says what to set.
    """
    environment = open_floor(robot)
    import mujoco

    try:
        renderer = mujoco.Renderer(environment.model, *SIZE_PX)
    except (mujoco.FatalError, ImportError, RuntimeError, AttributeError) as error:
        raise SimulatorError(f'{rendering_help()} ({error})') from error

    camera = mujoco.MjvCamera()
    camera.distance, camera.elevation, camera.azimuth = 3.6, -25.0, 60.0
    environment.model.vis.headlight.ambient[:] = 0.5  # OGBench's light is for small pictures
    pictures = []
    stride = max(1, round(1 / (FRAMES_PER_S * walk.period_s)))
    with renderer:
        for step in range(0, len(walk.directions), stride):
            environment.set_state(walk.qpos[step], np.zeros(environment.model.nv))
            camera.lookat[:] = (*walk.path[step], 0.7)
            renderer.update_scene(environment.data, camera)
            scene = renderer.scene
            scene.ngeom += 1
            arrow = scene.geoms[scene.ngeom - 1]
            start, end = (
                np.array([*(walk.path[step] + reach_m * walk.directions[step]), 0.05])
                for reach_m in _ARROW_M
            )
            kind = mujoco.mjtGeom.mjGEOM_ARROW
            mujoco.mjv_initGeom(
                arrow, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), _ARROW_RGBA
            )
            mujoco.mjv_connector(arrow, kind, 0.04, start, end)
            pictures.append(renderer.render().copy())
    environment.close()
    return pictures
