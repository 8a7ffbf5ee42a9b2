"""The maze in three dimensions: walls, data, robot, goal, retrieved data and action fields."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from sim_bridge import MazeMap
import viser

Color = tuple[int, int, int]
Point = tuple[float, float, float]
FLOOR: Color = (238, 238, 238)
WALL: Color = (120, 130, 145)
DATA: Color = (190, 190, 190)
RETRIEVED: Color = (0, 114, 178)
ROBOT: Color = (213, 94, 0)
GOAL: Color = (255, 200, 0)
BEFORE: Color = (170, 30, 110)
AFTER: Color = (0, 100, 60)

_DATA_POINTS = 8000
_SEGMENT_POINTS = 4000


class MazeScene:
    """What is in the scene; positions are in metres. Everything lies on the floor, z = 0."""

    def __init__(self, server: viser.ViserServer, maze: MazeMap) -> None:
        """Build floor and walls and look at them.

        Args:
            server: Whose scene it is; what was in it goes.
            maze: The maze.
        """
        self._server, self._scene = server, server.scene
        self._unit = maze.unit_m
        self._scene.reset()
        xmin, xmax, ymin, ymax = maze.extent
        center = ((xmin + xmax) / 2, (ymin + ymax) / 2)
        thick = 0.1
        with server.atomic():
            self._scene.add_box(
                '/floor',
                color=FLOOR,
                dimensions=(xmax - xmin, ymax - ymin, thick),
                position=(*center, -thick / 2),
            )
            height = maze.unit_m / 3
            for row, col in np.argwhere(maze.walls):
                x, y = maze.center(row, col)
                self._scene.add_box(
                    f'/walls/{row}-{col}',
                    color=WALL,
                    dimensions=(maze.unit_m, maze.unit_m, height),
                    position=(x, y, height / 2),
                )
            self._robot = self._scene.add_icosphere(
                '/robot', radius=0.18 * maze.unit_m, color=ROBOT, visible=False
            )
            self._goal = self._scene.add_cylinder(
                '/goal', radius=1.0, height=thick, color=GOAL, visible=False
            )
        camera = server.initial_camera
        camera.position, camera.look_at = (np.array(point) for point in viewpoint(maze))

    def move_robot(self, xy: tuple[float, float]) -> None:
        """Put the robot at a position."""
        self._robot.position = (*xy, self._robot.radius)
        self._robot.visible = True

    def show_goal(self, xy: tuple[float, float] | None, radius_m: float) -> None:
        """Show the goal with its tolerance, or none."""
        self._goal.visible = xy is not None
        if xy is not None:
            self._goal.radius = radius_m
            self._goal.position = (*xy, 0.05)

    def show_data(self, positions: NDArray[np.floating]) -> None:
        """Show where the dataset has states, (n, 2), thinned."""
        stride = max(1, len(positions) // _DATA_POINTS)
        self._scene.add_point_cloud(
            '/data',
            _raised(positions[::stride], 0.03),
            DATA,
            point_size=0.03 * self._unit,
            point_shape='circle',
            point_shading='flat',
        )

    def show_retrieved(self, segments: Sequence[NDArray[np.floating]]) -> None:
        """Show sub-trajectories, each (n, 2), thinned."""
        stride = max(1, sum(map(len, segments)) // _SEGMENT_POINTS)
        lines = [np.concatenate([line[:-1:stride], line[-1:]]) for line in segments]
        pairs = [np.stack([line[:-1], line[1:]], 1) for line in lines]
        self._scene.add_line_segments(
            '/retrieved',
            _raised(np.concatenate([np.empty((0, 2, 2)), *pairs]), 0.06),
            RETRIEVED,
            thickness=0.025 * self._unit,
        )

    def show_field(
        self, name: str, color: Color, positions: NDArray, actions: NDArray, height_m: float
    ) -> None:
        """Show an action field as arrows.

        Args:
            name: Its name in the scene.
            color: Its colour.
            positions: (n, 2) where the arrows begin.
            actions: (n, 2) actions in [-1, 1].
            height_m: Height above the floor.
        """
        tips = positions + 0.27 * self._unit * actions
        self._scene.add_arrows(
            f'/{name}',
            _raised(np.stack([positions, tips], 1), height_m),
            color,
            shaft_radius=0.018 * self._unit,
            head_radius=0.05 * self._unit,
            head_length=0.08 * self._unit,
        )

    def remove(self, name: str) -> None:
        """Take something out of the scene, if it is there."""
        self._scene.remove_by_name(f'/{name}')


def viewpoint(maze: MazeMap) -> tuple[Point, Point]:
    """The first position of the camera, and the point it looks at."""
    xmin, xmax, ymin, ymax = maze.extent
    x, y = (xmin + xmax) / 2, (ymin + ymax) / 2
    size = max(xmax - xmin, ymax - ymin)
    return (x, y - 0.2 * size, 0.66 * size), (x, y, 0.0)


def floor_point(origin: Sequence[float], direction: Sequence[float]) -> tuple[float, float] | None:
    """The point (x, y) at which a ray meets the floor; None when it looks away from it."""
    if direction[2] * origin[2] >= 0:
        return None
    scale = -origin[2] / direction[2]
    return origin[0] + scale * direction[0], origin[1] + scale * direction[1]


def _raised(points: NDArray[np.floating], height_m: float) -> NDArray[np.float32]:
    """Points (..., 2) at a height, (..., 3)."""
    heights = np.full((*points.shape[:-1], 1), height_m)
    return np.concatenate([points, heights], -1).astype(np.float32)
