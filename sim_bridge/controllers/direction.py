"""Direction followers: from where the robot should go to what its motors do."""

from typing import Protocol

from sim_bridge.simulator import Array, SimulatorSpec


class ControllerError(ValueError):
    """There is no controller that can drive a robot."""


class DirectionFollower(Protocol):
    """Drives a robot along a direction, without looking at the maze."""

    def act(self, observation: Array, direction: Array) -> Array:
        """Action that moves the robot along `direction`.

        Args:
            observation: Shape (obs_dim,).
            direction: Unit vector (x, y) in the frame of the maze.

        Returns:
            Action of shape (act_dim,), before any noise.
        """


class PointFollower:
    """Follows a direction with the point, whose action is the direction it moves in."""

    def act(self, observation: Array, direction: Array) -> Array:
        """Return the direction itself."""
        return direction


def make_direction_follower(spec: SimulatorSpec) -> DirectionFollower:
    """Find the controller that follows directions with a robot.

    Raises:
        ControllerError: If the robot needs a learned controller; says what is missing.
    """
    robot = spec.name.split('-')[0]
    if robot == 'pointmaze':
        return PointFollower()
    raise ControllerError(
        f'{spec.name}: walking takes a learned direction controller ({spec.obs_dim} observation '
        f'and {spec.act_dim} action dimensions), and none is available for {robot}; data can be '
        "generated for pointmaze, and OGBench's published datasets can be used for the others"
    )
