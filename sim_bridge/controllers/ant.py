"""The ant's fourfold symmetry, which makes one quarter of a learned controller do for all."""

import math

import numpy as np
from numpy.typing import NDArray

from sim_bridge.controllers.learned import LearnedFollower
from sim_bridge.simulator import Array

_SECTOR_START_RAD = -math.pi / 8
"""Directions are turned into the quarter that begins here; it has axes and diagonals inside."""


class AntFollower(LearnedFollower):
    """Uses the best learned quarter of all directions, four times.

    Turn the world by 90 degrees about the vertical, then call each leg by the name of its
    neighbour: the ant looks as before and heads where it did, but the direction is a quarter turn
    away. Any direction thus becomes one between -22.5 and 67.5 degrees, and the ant walks
    equally well along the whole compass.
    """

    def act(self, observation: Array, direction: Array, qpos: Array) -> Array:
        """Action for an observation of shape (29,) that moves along `direction`."""
        angle = math.atan2(direction[1], direction[0]) - _SECTOR_START_RAD
        turns = math.floor(angle / (math.pi / 2)) % 4
        inputs = np.concatenate([observation[2:], direction])
        return turn_action(self.network(turn_inputs(inputs, turns)), -turns)


def turn_inputs(inputs: Array, turns: int) -> Array:
    """Own state and direction, shape (29,), after quarter turns of the world, clockwise."""
    return inputs[_INPUT_SOURCES[turns % 4]] * _INPUT_SIGNS[turns % 4]


def turn_action(action: Array, turns: int) -> Array:
    """The action, shape (8,), that does the same after quarter turns of the world, clockwise."""
    return action[_ACTION_SOURCES[turns % 4]] * _ACTION_SIGNS[turns % 4]


# What each number becomes in a quarter turn: plus or minus the number in which place, from 1.
_INPUTS = (
    *(1, 2, 4, -3, 5),  # height; quaternion w, x, y, z
    *(8, -9, 10, 11, 12, -13, 6, 7),  # hip and ankle of the legs 1 to 4
    *(15, -14, 16),  # velocity in the world
    *(18, -17, 19),  # angular velocity in the torso
    *(22, -23, 24, 25, 26, -27, 20, 21),  # velocities of the joints
    *(29, -28),  # direction
)
_ACTION = (3, 4, 5, -6, 7, 8, 1, -2)  # hip and ankle of the legs 4, 1, 2, 3


def _powers(table: tuple[int, ...]) -> tuple[NDArray[np.int64], Array]:
    """Sources and signs of none to three turns, each of shape (4, numbers)."""
    values = np.arange(1, len(table) + 1)
    rows = [values]
    for _ in range(3):
        values = values[np.abs(table) - 1] * np.sign(table)
        rows.append(values)
    return np.abs(rows) - 1, np.sign(rows).astype(np.float64)


_INPUT_SOURCES, _INPUT_SIGNS = _powers(_INPUTS)
_ACTION_SOURCES, _ACTION_SIGNS = _powers(_ACTION)
