"""The arm in ROS: joint states; takes positions as a forward_command_controller does."""

import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from metagcttt_robots.arm import Arm, JOINTS
from metagcttt_robots.simulated import RELIABLE, SimulatedRobot

RATE_HZ = 20.0
TELLING = (2, 0, 3, 1)
"""The order of the joints in `joint_states`, which is nobody's but the sender's."""


class ArmNode(SimulatedRobot):
    """Tells `joint_states`, obeys `arm_controller/commands`: pan, lift, elbow, wrist."""

    def __init__(self) -> None:
        """Put the arm at home."""
        self._robot = Arm()
        super().__init__('arm', RATE_HZ, self._robot.advance)
        self._joints = self.create_publisher(JointState, 'joint_states', RELIABLE)
        self.create_subscription(
            Float64MultiArray, 'arm_controller/commands', self._on_command, RELIABLE
        )

    def sense(self) -> None:
        """Send the joints' positions and speeds."""
        positions, speeds = self._robot.joints
        message = JointState(header=self.header(''), name=[JOINTS[i] for i in TELLING])
        message.position = positions[list(TELLING)].tolist()
        message.velocity = speeds[list(TELLING)].tolist()
        self.send(self._joints, message)

    def _on_command(self, message: Float64MultiArray) -> None:
        target = np.array(message.data)
        if target.shape == (len(JOINTS),) and np.isfinite(target).all():
            self._robot.command(target)
            self.commanded()
