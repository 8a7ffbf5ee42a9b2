"""The ant's fourfold symmetry, which makes one quarter of a learned controller do for all."""

import math

import numpy as np

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
    return _INPUT_TURNS[turns % 4] @ inputs


def turn_action(action: Array, turns: int) -> Array:
    """The action, shape (8,), that does the same after quarter turns of the world, clockwise."""
    return _ACTION_TURNS[turns % 4] @ action


def _block_diagonal(*blocks: Array) -> Array:
    """A square matrix with the blocks along its diagonal, and zeros."""
    size = sum(len(block) for block in blocks)
    matrix, start = np.zeros((size, size)), 0
    for block in blocks:
        stop = start + len(block)
        matrix[start:stop, start:stop] = block
        start = stop
    return matrix


def _legs_renamed(order: tuple[int, ...]) -> Array:
    """Hip and ankle of the legs in `order`: each leg becomes the next one.

    The ankles of the legs 1 and 4 bend the other way round than those of 2 and 3.
    """
    bend = {1: 1, 2: -1, 3: -1, 4: 1}
    matrix = np.zeros((8, 8))
    for place, leg in enumerate(order):
        following = leg % 4 + 1
        source = order.index(following)
        matrix[2 * place, 2 * source] = 1
        matrix[2 * place + 1, 2 * source + 1] = bend[leg] * bend[following]
    return matrix


_UNCHANGED = np.eye(1)
_PLANAR = np.array([[0.0, 1.0], [-1.0, 0.0]])
_VECTOR = _block_diagonal(_PLANAR, _UNCHANGED)
_JOINTS = _legs_renamed((1, 2, 3, 4))
_INPUT_TURN = _block_diagonal(
    _UNCHANGED,  # height
    *(_UNCHANGED, _VECTOR),  # quaternion: w; x, y, z
    _JOINTS,  # angles
    *(_VECTOR, _VECTOR),  # velocity in the world, angular velocity in the torso
    _JOINTS,  # their velocities
    _PLANAR,  # direction
)
_ACTION_TURN = _legs_renamed((4, 1, 2, 3))
_INPUT_TURNS, _ACTION_TURNS = (
    [np.linalg.matrix_power(turn, count) for count in range(4)]
    for turn in (_INPUT_TURN, _ACTION_TURN)
)
