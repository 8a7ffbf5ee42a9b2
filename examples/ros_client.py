"""Send a running graph to a goal over ROS 2 and wait until the robot is there.

Try it: start sim_bridge_node, goal_node and policy_node, then python examples/ros_client.py 20 20
"""

import sys

from metagcttt.commander import RobotCommander
import rclpy

rclpy.init()
commander = RobotCommander()
result = commander.reach([float(value) for value in sys.argv[1:]] or (20.0, 20.0), timeout_s=60)
if result.success:
    print(f'reached after {result.steps} steps, {result.seconds:.1f} s')
else:
    print(f'not reached: {result.error_msg}')
commander.destroy_node()
rclpy.try_shutdown()
sys.exit(not result.success)
