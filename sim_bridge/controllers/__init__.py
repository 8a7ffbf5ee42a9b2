"""Controllers that walk a robot in a given direction; they produce the offline data."""

from sim_bridge.controllers.ant import AntFollower
from sim_bridge.controllers.direction import load_follower, make_direction_follower
from sim_bridge.controllers.follower import (
    ControllerError,
    DirectionFollower,
    PointFollower,
    VelocityFollower,
)
from sim_bridge.controllers.humanoid import HumanoidFollower
from sim_bridge.controllers.learned import LearnedFollower

__all__ = [
    'AntFollower',
    'ControllerError',
    'DirectionFollower',
    'HumanoidFollower',
    'LearnedFollower',
    'PointFollower',
    'VelocityFollower',
    'load_follower',
    'make_direction_follower',
]
