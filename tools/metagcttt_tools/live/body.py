"""The body of a simulated robot in its MuJoCo geometry, posed by an observation."""

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray
from sim_bridge import make_simulator
from sim_bridge.mazes.gym_maze import GymMaze
import trimesh

from metagcttt_tools.live.scene import one_mesh

Pose = tuple[NDArray[np.float64], NDArray[np.float64]]
_STILL_M_S = 0.3  # below this a humanoid's direction of motion says nothing


class Body:
    """The links of an ant or a humanoid.

    Attributes:
        meshes: The shape of each link, in its own frame, metres.
    """

    def __init__(self, environment: str) -> None:
        """Build the model of a simulator.

        Args:
            environment: Name of the simulator.

        Raises:
            ValueError: If its robot is not one of those: a point has no pose.
        """
        with make_simulator(environment) as simulator:
            if not isinstance(simulator, GymMaze):
                raise ValueError(f'{environment}: not a MuJoCo environment')
            self._model = simulator.environment.model
            if simulator.spec.obs_dim == 69:
                self._place: Callable[[NDArray], None] = self._place_humanoid
            elif self._model.nq == 15:
                self._place = self._place_ant
            else:
                raise ValueError(f'{environment}: the robot has no links')
            self._data = mujoco.MjData(self._model)
            root = self._model.body('torso').id
            self._links = np.flatnonzero(self._model.body_rootid == root)
            self.meshes = [self._mesh(int(link)) for link in self._links]
        self._heading_rad = 0.0

    def pose(self, observation: NDArray[np.floating]) -> list[Pose]:
        """Position and orientation (w, x, y, z) of each link."""
        self._place(observation)
        return [(self._data.xpos[i].copy(), self._data.xquat[i].copy()) for i in self._links]

    def _place_ant(self, observation: NDArray[np.floating]) -> None:
        self._data.qpos[:] = observation[:15]
        mujoco.mj_kinematics(self._model, self._data)

    def _place_humanoid(self, observation: NDArray[np.floating]) -> None:
        """Place it by OGBench's observation, which lacks the heading: it looks where it goes.

        The observation: x, y, 21 joint angles, the height of the head, 12 coordinates of hands and
        feet, the vertical in the torso's frame, velocity of the center of mass, 27 velocities.
        """
        data = self._data
        vertical, velocity = observation[36:39], observation[39:41]
        if np.linalg.norm(velocity) > _STILL_M_S:
            self._heading_rad = float(np.arctan2(velocity[1], velocity[0]))
        upright = _shortest_turn(vertical, np.array([0.0, 0.0, 1.0]))
        forward = np.empty(3)
        mujoco.mju_rotVecQuat(forward, np.array([1.0, 0.0, 0.0]), upright)
        turn = self._heading_rad - np.arctan2(forward[1], forward[0])
        around_z = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        data.qpos[:3] = (*observation[:2], 0.0)
        mujoco.mju_mulQuat(data.qpos[3:7], around_z, upright)
        data.qpos[7:] = observation[2:23]
        mujoco.mj_kinematics(self._model, data)
        data.qpos[2] = observation[23] - data.body('head').xpos[2]
        mujoco.mj_kinematics(self._model, data)

    def _mesh(self, link: int) -> trimesh.Trimesh:
        first = self._model.body_geomadr[link]
        return one_mesh(
            [self._shape(geom) for geom in range(first, first + self._model.body_geomnum[link])]
        )

    def _shape(self, geom: int) -> trimesh.Trimesh:
        """A sphere or a capsule, the only shapes of these robots, in the frame of its link."""
        radius, half_length = self._model.geom_size[geom][:2]
        if self._model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            shape = trimesh.creation.icosphere(2, radius)
        else:
            shape = trimesh.creation.capsule(2 * half_length, radius, count=(12, 12))
        shape.apply_transform(
            trimesh.transformations.quaternion_matrix(self._model.geom_quat[geom])
        )
        shape.apply_translation(self._model.geom_pos[geom])
        return shape


def _shortest_turn(start: NDArray, end: NDArray) -> NDArray[np.float64]:
    """The quaternion (w, x, y, z) of the shortest rotation between two unit vectors."""
    quaternion = np.array([1.0 + start @ end, *np.cross(start, end)])
    if quaternion[0] < 1e-9:  # opposite: by half a turn around any horizontal axis
        return np.array([0.0, 1.0, 0.0, 0.0])
    return quaternion / np.linalg.norm(quaternion)
