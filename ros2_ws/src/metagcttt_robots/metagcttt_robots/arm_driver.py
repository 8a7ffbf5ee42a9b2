"""Moves an arm to places or random positions of its joints, over what is beside it, with noise."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from metagcttt_robots.simulated import number, RELIABLE

JOINTS = ('pan_joint', 'lift_joint', 'elbow_joint', 'wrist_joint')
LOW = np.array([-1.4, -0.1, -1.8, -1.0])
HIGH = np.array([1.4, 1.2, 0.0, 1.0])
STEP = 0.12
"""How far ahead of the joints their targets are, rad."""
NEAR = 0.1
PATIENCE = 100
RAISED = 1.1
"""Lift from which the arm passes over the post, rad."""


class ArmDriver(Node):
    """Answers every `joint_states` with targets on `arm_controller/commands`."""

    def __init__(self, **kwargs: Any) -> None:
        """Wait for the arm.

        Args:
            kwargs: For `rclpy.node.Node`.

        Raises:
            ValueError: If `places` are not positions of all joints, within the limits.
        """
        super().__init__('arm_driver', **kwargs)
        self._noise = number(self, 'noise', 0.03, 0.0, 1.0, 'deviation of the targets, rad')
        places = self.declare_parameter(
            'places',
            [0.0],
            ParameterDescriptor(
                description='pan, lift, elbow, wrist, pan, ... (rad) to move between; '
                '[0.0]: anywhere',
                read_only=True,
            ),
        ).value
        self._places = _as_places(places if len(places) > 1 else [])
        seed = number(self, 'seed', 0.0, 0.0, 1e9, 'of goals and noise')
        self._rng = np.random.default_rng(int(seed))
        self._way: list[NDArray[np.float64]] = []
        self._periods = 0
        self._drawn = np.zeros(len(JOINTS))
        self._commands = self.create_publisher(
            Float64MultiArray, 'arm_controller/commands', RELIABLE
        )
        self.create_subscription(JointState, 'joint_states', self._on_joints, RELIABLE)

    def _on_joints(self, message: JointState) -> None:
        measured = dict(zip(message.name, message.position, strict=True))
        here = np.array([measured[joint] for joint in JOINTS])
        self._periods += 1
        if self._way and (np.abs(self._way[0] - here).max() < NEAR or self._periods > PATIENCE):
            self._way.pop(0)
            self._periods = 0
        if not self._way:
            self._way = self._plan(here)
        self._drawn = 0.9 * self._drawn + 0.45 * self._rng.standard_normal(len(JOINTS))
        towards = np.clip(self._way[0] - here, -STEP, STEP)
        target = here + towards + self._noise * self._drawn
        self._commands.publish(Float64MultiArray(data=target.tolist()))

    def _plan(self, here: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Straight to a goal, or raised across the middle and down again."""
        goal = self._goal(here)
        if here[0] * goal[0] > 0:
            return [goal]
        over = [here.copy(), goal.copy()]
        for point in over:
            point[1], point[2] = RAISED, -0.3
        return [*over, goal]

    def _goal(self, here: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions to move to: another place, or any."""
        others = self._places[np.abs(self._places - here).max(axis=1) > 2 * NEAR]
        if len(others):
            return np.asarray(others[self._rng.integers(len(others))])
        return self._rng.uniform(LOW, HIGH)


def _as_places(numbers: Sequence[float]) -> NDArray[np.float64]:
    """Positions of all joints, (n, 4), rad."""
    if len(numbers) % len(JOINTS):
        raise ValueError(f'places needs {len(JOINTS)} numbers each, got {len(numbers)}')
    places = np.array(numbers, float).reshape(-1, len(JOINTS))
    if ((places < LOW) | (places > HIGH)).any():
        raise ValueError(f'places are from {LOW.tolist()} to {HIGH.tolist()}, got {numbers}')
    return places
