"""Messages without ROS, and contracts for them."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from metagcttt_core.robot import Contract
import yaml

ROBOTS = Path(__file__).parents[3] / 'config' / 'robots'
SECOND = 10**9

DRIVE = """
robot: cart
rate_hz: 10
position: [x, y]
observe:
  - topic: odom
    type: nav_msgs/msg/Odometry
    frame_id: odom
    stamp: header
    values:
      - {field: pose.pose.position.x, name: x, max_rate: 2.0}
      - {field: pose.pose.position.y, name: y, origin: 5000000}
      - {field: pose.pose.orientation, name: yaw, transform: heading}
act:
  - topic: cmd_vel
    type: geometry_msgs/msg/Twist
    values:
      - {field: linear.x, low: -0.5, high: 1.0, max_rate: 1.0}
      - {field: angular.z, low: -2, high: 2}
    fallback: zeros
"""
ARM = """
robot: arm
rate_hz: 10
observe:
  - topic: joint_states
    type: sensor_msgs/msg/JointState
    stamp: receive
    values:
      - {field: position, joints: [a, b]}
act:
  - topic: targets
    type: std_msgs/msg/Float64MultiArray
    values:
      - {field: data, joints: [b, a], measured: position, low: -3, high: [3, 2], max_rate: 1}
    fallback: {fault: hold, silent: hold, no_goal: hold, stop: hold, shutdown: nothing}
"""


def contract(text: str = DRIVE) -> Contract:
    return Contract.model_validate(yaml.safe_load(text))


def header(stamp_ns: int, frame_id: str = 'odom') -> SimpleNamespace:
    sec, nanosec = divmod(stamp_ns, SECOND)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame_id)


def odometry(
    stamp_ns: int,
    x: float = 0.0,
    y: float = 5e6,
    frame_id: str = 'odom',
    quaternion: tuple[float, ...] = (0, 0, 0, 1),
) -> Any:
    orientation = SimpleNamespace(**dict(zip('xyzw', quaternion, strict=True)))
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=y), orientation=orientation)
    return SimpleNamespace(header=header(stamp_ns, frame_id), pose=SimpleNamespace(pose=pose))


def joints(**positions: float) -> Any:
    return SimpleNamespace(name=list(positions), position=list(positions.values()))
