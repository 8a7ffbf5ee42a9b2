"""Drives a robot with two wheels to random goals of its map, by pure pursuit with noise."""

from typing import Any

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from metagcttt_robots.planner import inflate, shortest_path
from metagcttt_robots.simulated import LATCHED, number, RELIABLE

LOOK_AHEAD_M = 0.4
NEAR_M = 0.25
STUCK_PERIODS = 40


class DiffbotDriver(Node):
    """Answers every `odom` with a `cmd_vel`."""

    def __init__(self, **kwargs: Any) -> None:
        """Wait for the map and the robot.

        Args:
            kwargs: For `rclpy.node.Node`.
        """
        super().__init__('diffbot_driver', **kwargs)
        self._speed = number(self, 'speed', 0.7, 0.01, 10.0, 'on a straight way, m/s')
        self._noise = number(
            self, 'noise', 0.3, 0.0, 10.0, 'deviation of the commands, as a share of the speed'
        )
        self._clearance_m = number(self, 'clearance_m', 0.3, 0.0, 10.0, 'to obstacles, m')
        places = self.declare_parameter(
            'places',
            [0.0],
            ParameterDescriptor(
                description='x, y, x, y, ... (m) to drive between; [0.0]: anywhere on the map',
                read_only=True,
            ),
        ).value
        self._places = np.array(places if len(places) > 1 else []).reshape(-1, 2)
        seed = number(self, 'seed', 0.0, 0.0, 1e9, 'of goals and noise')
        self._rng = np.random.default_rng(int(seed))
        self._map: OccupancyGrid | None = None
        self._free = np.zeros((0, 2), int)
        self._path = np.zeros((0, 2))
        self._drawn = np.zeros(2)
        self._periods = self._back_off = 0
        self._anchor = np.zeros(2)
        self._commands = self.create_publisher(TwistStamped, 'cmd_vel', RELIABLE)
        self.create_subscription(OccupancyGrid, 'map', self._on_map, LATCHED)
        self.create_subscription(Odometry, 'odom', self._on_odometry, RELIABLE)

    def _on_map(self, message: OccupancyGrid) -> None:
        occupied = np.array(message.data).reshape(message.info.height, message.info.width) != 0
        cells = round(self._clearance_m / message.info.resolution)
        self._occupied = inflate(occupied, cells)
        self._free = np.argwhere(~self._occupied)
        self._map = message

    def _on_odometry(self, message: Odometry) -> None:
        if self._map is None:
            return
        pose = message.pose.pose
        here = np.array([pose.position.x, pose.position.y])
        yaw = 2 * np.arctan2(pose.orientation.z, pose.orientation.w)
        self._notice_progress(here)
        if not len(self._path) or np.linalg.norm(self._path[-1] - here) < NEAR_M:
            self._plan(here)
        v, w = self._pursue(here, yaw)
        # Noise that lasts about a second, so that it moves the robot off its way.
        self._drawn = 0.9 * self._drawn + 0.45 * self._rng.standard_normal(2)
        noise = self._noise * self._speed * self._drawn
        command = TwistStamped()
        command.header.stamp = message.header.stamp
        command.header.frame_id = 'base_link'
        command.twist.linear.x = float(np.clip(v + 0.5 * noise[0], -self._speed, self._speed))
        command.twist.angular.z = float(np.clip(w + 3 * noise[1], -2.0, 2.0))
        self._commands.publish(command)

    def _pursue(self, here: NDArray[np.float64], yaw: float) -> tuple[float, float]:
        if self._back_off:
            self._back_off -= 1
            return -0.5 * self._speed, 0.0
        if not len(self._path):
            return 0.0, 0.0
        nearest = int(np.linalg.norm(self._path - here, axis=1).argmin())
        ahead = np.linalg.norm(self._path[nearest:] - here, axis=1) > LOOK_AHEAD_M
        target = self._path[nearest + int(ahead.argmax()) if ahead.any() else -1]
        wanted = np.arctan2(*(target - here)[::-1])
        error = np.arctan2(np.sin(wanted - yaw), np.cos(wanted - yaw))
        return self._speed * max(0.0, np.cos(error)) ** 2, 2.5 * error

    def _notice_progress(self, here: NDArray[np.float64]) -> None:
        """Back off from where it has not moved for a while, and drive elsewhere."""
        self._periods += 1
        if np.linalg.norm(here - self._anchor) > 0.2:
            self._anchor, self._periods = here, 0
        elif self._periods > STUCK_PERIODS:
            self._path, self._back_off, self._periods = self._path[:0], 10, 0

    def _plan(self, here: NDArray[np.float64]) -> None:
        assert self._map is not None
        info = self._map.info
        origin = np.array([info.origin.position.x, info.origin.position.y])
        start = self._cell(here, origin)
        goal = self._goal(here, origin)
        path = shortest_path(self._occupied, tuple(start.tolist()), tuple(goal.tolist()))
        self._path = (
            origin + (np.array(path, float).reshape(-1, 2)[:, ::-1] + 0.5) * info.resolution
        )

    def _goal(self, here: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.int64]:
        """A free cell to drive to: that of another place, or any."""
        others = self._places[np.linalg.norm(self._places - here, axis=1) > 2 * NEAR_M]
        if len(others):
            return self._cell(others[self._rng.integers(len(others))], origin)
        return np.asarray(self._free[self._rng.integers(len(self._free))])

    def _cell(self, place: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.int64]:
        """The free cell nearest to a place, row and column."""
        assert self._map is not None
        cell = np.floor((place - origin) / self._map.info.resolution).astype(int)[::-1]
        return np.asarray(self._free[np.abs(self._free - cell).sum(axis=1).argmin()])
