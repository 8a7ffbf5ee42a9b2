"""Film the ant in its maze: the policies side by side, from above, each with its trail."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.colors import to_rgba
import numpy as np
from PIL import Image, ImageDraw
from sim_bridge import make_simulator
from sim_bridge.mazes.gym_maze import GymMaze

from metagcttt_tools.common.film import add_shape, Picture, renderer, write_film
from metagcttt_tools.common.plots import COLORS
from metagcttt_tools.graph.client import GoalOutcome

SIZE_PX = 260, 260
FRAME_MS = 60
STRIDE = 12
"""Control steps, of 0.1 s, from one picture to the next."""
_HELD = 10
"""Pictures of the end of a task."""
_TITLE_PX = 30
_CAMERA = {'elevation': -78.0, 'azimuth': 90.0, 'distance': 38.0}
_TRAIL_M = 0.28


def film(environment: str, outcomes: Mapping[str, Sequence[GoalOutcome]], path: Path) -> None:
    """Write a GIF of every task, one after another, with one panel an arm.

    Args:
        environment: Name of the ant's maze.
        outcomes: Of each task by arm.
        path: The file.

    Raises:
        SimulatorError: If this machine cannot draw without a display; says what to set.
    """
    panels = [
        _draw_arm(environment, arm, drives, color, _lengths(outcomes))
        for (arm, drives), color in zip(outcomes.items(), COLORS, strict=False)
    ]
    write_film(path, [np.hstack(row) for row in zip(*panels, strict=True)], FRAME_MS)


def _lengths(outcomes: Mapping[str, Sequence[GoalOutcome]]) -> list[int]:
    """Pictures of each task: until its last arm has ended."""
    by_task = zip(*outcomes.values(), strict=True)
    return [
        1 + max(-(-(len(each.observations) - 1) // STRIDE) for each in same_task)
        for same_task in by_task
    ]


def _draw_arm(
    environment: str,
    arm: str,
    drives: Sequence[GoalOutcome],
    color: str,
    lengths: Sequence[int],
) -> list[Picture]:
    """Pictures of one arm's tasks, `lengths` of each and then its end held."""
    pictures = []
    with make_simulator(environment) as simulator:
        import mujoco  # not earlier: the simulator chooses MuJoCo's OpenGL library

        assert isinstance(simulator, GymMaze), 'an ant walks in MuJoCo'
        model = simulator.environment.model
        data = mujoco.MjData(model)
        xmin, xmax, ymin, ymax = simulator.maze.extent
        camera = mujoco.MjvCamera()
        camera.lookat[:] = ((xmin + xmax) / 2, (ymin + ymax) / 2, 0)
        for name, value in _CAMERA.items():
            setattr(camera, name, value)
        with renderer(model, SIZE_PX) as draw:
            draw.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = (
                False  # most of the time without a GPU
            )
            for task, (drive, length) in enumerate(zip(drives, lengths, strict=True), 1):
                model.geom('target').pos[:2] = drive.goal
                last = len(drive.observations) - 1
                for number in range(length):
                    step = min(number * STRIDE, last)
                    data.qpos[:] = drive.observations[step][: model.nq]
                    mujoco.mj_forward(model, data)
                    draw.update_scene(data, camera)
                    for x, y in drive.path[: step + 1 : STRIDE // 2]:
                        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
                        add_shape(
                            draw.scene, sphere, to_rgba(color), (x, y, 0.1), (_TRAIL_M, 0, 0)
                        )
                    state = '' if step < last else _ending(drive)
                    pictures.append(_titled(draw.render(), arm, f'task {task}{state}', color))
                pictures += pictures[-1:] * _HELD
    return pictures


def _ending(drive: GoalOutcome) -> str:
    return f': reached, {drive.steps} steps' if drive.success else ': not reached'


def _titled(picture: Picture, arm: str, line: str, color: str) -> Picture:
    """The picture below two lines of text."""
    titled = Image.new('RGB', (picture.shape[1], picture.shape[0] + _TITLE_PX), 'white')
    titled.paste(Image.fromarray(picture), (0, _TITLE_PX))
    pen = ImageDraw.Draw(titled)
    pen.text((6, 2), arm, fill=color)
    pen.text((6, 15), line, fill='black')
    return np.asarray(titled)
