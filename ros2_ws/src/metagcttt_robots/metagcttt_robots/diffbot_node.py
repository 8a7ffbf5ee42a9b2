"""The robot with two wheels in ROS: odometry, joint states and a map; takes velocities."""

from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from metagcttt_robots.diffbot import Diffbot, JOINTS
from metagcttt_robots.room import CELLS_PER_UNIT, lower_corner, obstacles, UNIT_M
from metagcttt_robots.simulated import LATCHED, number, RELIABLE, SimulatedRobot

RATE_HZ = 10.0
FRAME = 'map'


class DiffbotNode(SimulatedRobot):
    """Tells `odom`, `joint_states` and `map`, obeys `cmd_vel`.

    The pose of `odom` is in the frame of the map, as that of a robot that localises itself, with
    the errors of the parameters `noise_m` and `drift`. A message on `initialpose` puts the robot
    somewhere else.
    """

    def __init__(self) -> None:
        """Put the robot at its start and send the map."""
        self._robot = Diffbot()
        super().__init__('diffbot', RATE_HZ, self._robot.advance)
        self._noise_m = number(self, 'noise_m', 0.0, 0.0, 10.0, 'deviation of each position, m')
        self._drift = number(
            self, 'drift', 0.0, 0.0, 1.0, 'deviation of the error that grows by the metre, m'
        )
        self._error = np.zeros(2)
        self._odometry = self.create_publisher(Odometry, 'odom', RELIABLE)
        self._joints = self.create_publisher(JointState, 'joint_states', RELIABLE)
        self._map = self.create_publisher(OccupancyGrid, 'map', LATCHED)
        self._map.publish(self._grid())
        self.create_subscription(TwistStamped, 'cmd_vel', self._on_command, RELIABLE)
        self.create_subscription(
            PoseWithCovarianceStamped, 'initialpose', self._on_place, RELIABLE
        )

    def sense(self) -> None:
        """Send odometry and the wheels' angles."""
        self.send(self._odometry, self._odometry_message())
        angles, speeds = self._robot.wheels
        self.send(
            self._joints,
            JointState(
                header=self.header(''),
                name=list(JOINTS),
                position=angles.tolist(),
                velocity=speeds.tolist(),
            ),
        )

    def _on_command(self, message: TwistStamped) -> None:
        v, w = message.twist.linear.x, message.twist.angular.z
        if np.isfinite([v, w]).all():
            self._robot.command(v, w)
            self.commanded()

    def _on_place(self, message: PoseWithCovarianceStamped) -> None:
        pose = message.pose.pose
        yaw = 2 * np.arctan2(pose.orientation.z, pose.orientation.w)
        if np.isfinite([pose.position.x, pose.position.y, yaw]).all():
            self._robot.place(pose.position.x, pose.position.y, yaw)
            self._error[:] = 0

    def _odometry_message(self) -> Odometry:
        motion = self._robot.motion
        metres = abs(motion.v) * self.period_ns / 1e9
        self._error += self._normal() * self._drift * np.sqrt(metres)
        x, y = np.array([motion.x, motion.y]) + self._error + self._normal() * self._noise_m
        message = Odometry(header=self.header(FRAME), child_frame_id='base_link')
        message.pose.pose.position.x, message.pose.pose.position.y = float(x), float(y)
        message.pose.pose.orientation.z = float(np.sin(motion.yaw / 2))
        message.pose.pose.orientation.w = float(np.cos(motion.yaw / 2))
        message.twist.twist.linear.x = motion.v
        message.twist.twist.angular.z = motion.w
        return message

    def _normal(self) -> NDArray[np.float64]:
        return self.rng.standard_normal(2)

    def _grid(self) -> OccupancyGrid:
        cells = np.kron(obstacles(), np.ones((CELLS_PER_UNIT, CELLS_PER_UNIT), bool))
        grid = OccupancyGrid(header=self.header(FRAME))
        grid.info.resolution = UNIT_M / CELLS_PER_UNIT
        grid.info.height, grid.info.width = cells.shape
        grid.info.origin.position.x, grid.info.origin.position.y = lower_corner()
        grid.info.origin.orientation.w = 1.0
        grid.data = np.where(cells, 100, 0).ravel().tolist()
        return grid
