"""The maze in three dimensions: walls, data, robot, goal, retrieved data and action fields."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from sim_bridge import MazeMap
import trimesh
import viser

if TYPE_CHECKING:
    from metagcttt_tools.live.body import Body, Pose

Color = tuple[int, int, int]
Point = tuple[float, float, float]
FLOOR: Color = (238, 238, 238)
WALL: Color = (120, 130, 145)
DATA: Color = (190, 190, 190)
RETRIEVED: Color = (0, 114, 178)
ROBOT: Color = (213, 94, 0)
NOSE: Color = (90, 30, 0)
GOAL: Color = (255, 200, 0)
BEFORE: Color = (170, 30, 110)
AFTER: Color = (0, 100, 60)

LANDSCAPE = 4 / 3

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
        self._unit = scale_m(maze)
        self._scene.reset()
        self._links: list[viser.MeshHandle] = []
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
            if boxes := list(_wall_boxes(maze, self._unit / 3)):
                walls = one_mesh(boxes)
                self._scene.add_mesh_simple(
                    '/walls',
                    walls.vertices,
                    walls.faces,
                    color=WALL,
                    flat_shading=True,
                    receive_shadow=False,
                )
            self._robot = self._scene.add_icosphere(
                '/robot', radius=0.18 * self._unit, color=ROBOT, visible=False
            )
            self._nose = self._scene.add_arrows(
                '/nose',
                np.zeros((1, 2, 3)),
                NOSE,
                shaft_radius=0.04 * self._unit,
                head_radius=0.1 * self._unit,
                head_length=0.15 * self._unit,
                visible=False,
            )
            self._goal = self._scene.add_cylinder(
                '/goal', radius=1.0, height=thick, color=GOAL, visible=False
            )
        aim(server.initial_camera, *viewpoint(maze))

    def move_robot(self, xy: tuple[float, float], heading: tuple[float, float] | None) -> None:
        """Put the robot at a position; one without links also looks along a unit vector."""
        self._robot.position = (*xy, self._robot.radius)
        self._robot.visible = not self._links
        self._nose.visible = heading is not None
        if heading is not None:
            nose = np.array([np.zeros(2), 0.45 * self._unit * np.array(heading)]) + np.array(xy)
            self._nose.points = _raised(nose[None], 2 * self._robot.radius)  # over the walls

    def add_body(self, body: Body) -> None:
        """Give the robot its links, to be posed."""
        self._links = [
            self._scene.add_mesh_simple(
                f'/links/{number}', mesh.vertices, mesh.faces, color=ROBOT, visible=False
            )
            for number, mesh in enumerate(body.meshes)
        ]

    def pose(self, poses: Sequence[Pose]) -> None:
        """Put each link at its pose."""
        for link, (position, quaternion) in zip(self._links, poses, strict=True):
            link.position, link.wxyz = position, quaternion
            link.visible = True

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


def scale_m(maze: MazeMap) -> float:
    """The size of what is drawn: a cell of a maze, a part of the width of a finer map."""
    xmin, xmax, ymin, ymax = maze.extent
    return maze.unit_m if maze.unit_m >= 1 else max(xmax - xmin, ymax - ymin) / 10


def one_mesh(parts: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Several shapes as one."""
    return cast('trimesh.Trimesh', trimesh.util.concatenate(parts))


def _wall_boxes(maze: MazeMap, height_m: float) -> Iterator[trimesh.Trimesh]:
    """A box for every stretch of wall along a row."""
    for row, cells in enumerate(maze.walls):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], cells, [False]])))
        for begin, end in edges.reshape(-1, 2):
            (x0, y), (x1, _) = maze.center(row, begin), maze.center(row, end - 1)
            box = trimesh.creation.box((x1 - x0 + maze.unit_m, maze.unit_m, height_m))
            yield box.apply_translation(((x0 + x1) / 2, y, height_m / 2))


def viewpoint(maze: MazeMap, aspect: float = LANDSCAPE) -> tuple[Point, Point]:
    """The first position of the camera, and the point it looks at: all of the maze is in view.

    Args:
        maze: The maze.
        aspect: Width of the picture by its height. A telephone held upright has the maze in the
            upper two fifths, as the panel lies over the others.
    """
    xmin, xmax, ymin, ymax = maze.extent
    x, y = (xmin + xmax) / 2, (ymin + ymax) / 2
    # The near edge has to fit into a vertical field of view of 75 degrees.
    distance = max(xmax - xmin, ymax - ymin) * max(0.8, 0.16 + 0.68 / aspect)
    if aspect < 2 / 3:
        distance /= 1.16  # the maze is farther off than the point looked at, by the next line
        y -= 0.56 * distance
    return (x, y - 0.29 * distance, 0.957 * distance), (x, y, 0.0)


def aim(camera: Any, position: Point, target: Point) -> None:
    """Put a camera of viser somewhere, and turn it to a point."""
    camera.position = np.array(position)
    camera.look_at = np.array(target)


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
