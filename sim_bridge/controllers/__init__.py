"""Controllers that walk a robot in a given direction; they produce the offline data."""

from sim_bridge.controllers.direction import (
    ControllerError,
    DirectionFollower,
    make_direction_follower,
    PointFollower,
)

__all__ = [
    'ControllerError',
    'DirectionFollower',
    'PointFollower',
    'make_direction_follower',
]
