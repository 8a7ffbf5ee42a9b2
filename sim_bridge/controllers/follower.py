"""The interface of direction followers, and those without learning."""

from typing import Protocol

from sim_bridge.simulator import Array


class ControllerError(ValueError):
    """There is no controller that can drive a robot."""


class DirectionFollower(Protocol):
    """Drives a robot along a direction, without looking at the maze."""

    def act(self, observation: Array, direction: Array, qpos: Array) -> Array:
        """Action that moves the robot along `direction`.

        Args:
            observation: Shape (obs_dim,).
            direction: Unit vector (x, y) in the frame of the maze.
            qpos: Generalised positions of the simulator: a humanoid's observation lacks its
                heading.

        Returns:
            Action of shape (act_dim,), before any noise.
        """


class PointFollower:
    """Follows a direction with the point, whose action is the direction it moves in."""

    def act(self, observation: Array, direction: Array, qpos: Array) -> Array:
        """Return the direction itself."""
        return direction


class VelocityFollower:
    """Follows a direction with a point that is driven by forces, at a constant speed.

    Its observation is (x, y) in metres and the velocity in metres per second, and its action is
    proportional to the lack of velocity along x and y.
    """

    SPEED_M_S = 3.0
    GAIN = 1.0
    """Action per metre per second that is lacking."""

    def act(self, observation: Array, direction: Array, qpos: Array) -> Array:
        """Push towards the wanted velocity; an action may lie beyond -1 to 1, to be cut."""
        return self.GAIN * (self.SPEED_M_S * direction - observation[2:4])
