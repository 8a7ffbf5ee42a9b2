"""Bags of a cart and of an arm, written with the genuine types."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

TYPES = get_typestore(Stores.ROS2_JAZZY)
STEP = 10**8
T0 = 1_700_000_000 * 10**9


def make(type_name: str, **fields: Any) -> Any:
    return TYPES.types[type_name](**fields)


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    return make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)


def twist(v: float, w: float) -> Any:
    return make('geometry_msgs/msg/Twist', linear=vector(x=v), angular=vector(z=w))


def header(stamp_ns: int, frame_id: str = 'odom') -> Any:
    sec, nanosec = divmod(stamp_ns, 10**9)
    stamp = make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    return make('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)


def odometry(stamp_ns: int, x: float, y: float = 5e6, yaw: float = 0.0) -> Any:
    rotation = {'x': 0.0, 'y': 0.0, 'z': float(np.sin(yaw / 2)), 'w': float(np.cos(yaw / 2))}
    pose = make(
        'geometry_msgs/msg/Pose',
        position=make('geometry_msgs/msg/Point', x=x, y=y, z=0.0),
        orientation=make('geometry_msgs/msg/Quaternion', **rotation),
    )
    zeros = np.zeros(36)
    return make(
        'nav_msgs/msg/Odometry',
        header=header(stamp_ns),
        child_frame_id='base_link',
        pose=make('geometry_msgs/msg/PoseWithCovariance', pose=pose, covariance=zeros),
        twist=make(
            'geometry_msgs/msg/TwistWithCovariance', twist=twist(0.0, 0.0), covariance=zeros
        ),
    )


def joint_state(stamp_ns: int, names: list[str], positions: list[float]) -> Any:
    nothing = np.zeros(0)
    return make(
        'sensor_msgs/msg/JointState',
        header=header(stamp_ns, ''),
        name=names,
        position=np.array(positions),
        velocity=nothing,
        effort=nothing,
    )


def drive(steps: int = 20, speed: float = 0.5) -> list[tuple[str, Any, int]]:
    """A cart that drives along x, observed once a period and commanded 20 ms later."""
    found = []
    for step in range(steps):
        now = T0 + step * STEP
        found.append(('/odom', odometry(now - 10**6, x=0.05 * step, yaw=0.1 * step), now))
        found.append(('/cmd_vel', twist(speed, 0.1 * step - 1.0), now + 2 * 10**7))
    return found


def turtlebot(steps: int) -> list[tuple[str, Any, int]]:
    """A TurtleBot 3 that drives along x, commanded by stamped messages."""
    found = []
    for topic, message, time_ns in drive(steps, speed=0.2):
        if topic == '/cmd_vel':
            fields = {'header': header(time_ns, 'base_link'), 'twist': twist(0.2, 0.0)}
            message = make('geometry_msgs/msg/TwistStamped', **fields)
        found.append((topic, message, time_ns))
    return found


def write(
    path: Path,
    messages: Iterable[tuple[str, Any, int]],
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression != CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with writer:
        for topic, message, time_ns in messages:
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=TYPES)
            writer.write(connections[topic], time_ns, TYPES.serialize_cdr(message, name))
    return path
