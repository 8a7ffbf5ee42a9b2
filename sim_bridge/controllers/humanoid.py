"""The humanoid's walking policy: what it sees, and its left-right symmetry."""

import numpy as np
from numpy.typing import NDArray

from sim_bridge.controllers.learned import LearnedFollower
from sim_bridge.simulator import Array

OBS_DIM = 69
"""Numbers in OGBench's observation of the humanoid."""
INPUT_DIM = 67
"""Numbers that the policy sees: the direction takes the place of x and y and more."""
_INPUT_LIMIT = 5.0

# Places in OGBench's observation; x and y come first, then these.
_JOINTS = slice(2, 23)
_HEAD_HEIGHT = 23
_LIMBS = slice(24, 36)
_VERTICAL = slice(36, 39)
_COM_VELOCITY = slice(39, 42)
_ANGULAR_VELOCITY = slice(45, 48)
_JOINT_VELOCITIES = slice(48, 69)

_LEG = ('hip_x', 'hip_z', 'hip_y', 'knee', 'ankle_y', 'ankle_x')
_LEG_MOTORS = ('hip_x', 'hip_z', 'hip_y', 'knee', 'ankle_x', 'ankle_y')
_ARM = ('shoulder1', 'shoulder2', 'elbow')


def _sided(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f'{side}_{name}' for side in ('right', 'left') for name in names)


JOINTS = ('abdomen_z', 'abdomen_y', 'abdomen_x', *_sided(_LEG), *_sided(_ARM))
"""Hinges in the order of the generalised positions."""
MOTORS = ('abdomen_y', 'abdomen_z', 'abdomen_x', *_sided(_LEG_MOTORS), *_sided(_ARM))
"""Motors in the order of an action."""


class HumanoidFollower(LearnedFollower):
    """Walks the humanoid, whose observation does not tell its heading: that is in `qpos`."""

    @property
    def obs_dim(self) -> int:
        """Numbers in an observation of the humanoid, for a network of `input_dim`."""
        return self.input_dim + OBS_DIM - INPUT_DIM

    def act(self, observation: Array, direction: Array, qpos: Array) -> Array:
        """Action for an observation of shape (69,) that moves along `direction`."""
        return self.network(policy_inputs(observation, qpos[3:7], direction))


def policy_inputs(observations: Array, quaternions: Array, directions: Array) -> Array:
    """The inputs of the policy in the torso frame, which is defined in any posture.

    Joint angles (21), height of the head, the vertical (3), hands and feet (12), velocity of the
    centre of mass (3), angular velocity / 4 (3), joint velocities / 10 (21) and the direction
    (3), each cut to -5 to 5.

    Args:
        observations: OGBench's, shape (..., 69).
        quaternions: Of the torso, (w, x, y, z), shape (..., 4).
        directions: Unit vectors (x, y) in the frame of the maze, shape (..., 2).

    Returns:
        Shape (..., 67).
    """
    torso = rotation(quaternions)
    along = directions[..., :1] * torso[..., 0, :] + directions[..., 1:] * torso[..., 1, :]
    velocity = np.einsum('...i,...ij->...j', observations[..., _COM_VELOCITY], torso)
    inputs = np.concatenate(
        [
            observations[..., _JOINTS],
            head_height(observations)[..., None],
            observations[..., _VERTICAL],
            observations[..., _LIMBS],
            velocity,
            0.25 * observations[..., _ANGULAR_VELOCITY],
            0.1 * observations[..., _JOINT_VELOCITIES],
            along,
        ],
        axis=-1,
    )
    return inputs.clip(-_INPUT_LIMIT, _INPUT_LIMIT)


def head_height(observations: Array) -> Array:
    """Height of the head above the floor, metres, for observations of shape (..., 69)."""
    return observations[..., _HEAD_HEIGHT]


def uprightness(observations: Array) -> Array:
    """Cosine of the angle between the torso's axis and the vertical, shape (...)."""
    return observations[..., _VERTICAL][..., 2]


def com_velocity(observations: Array) -> Array:
    """Velocity of the centre of mass in the frame of the maze, (x, y) in m/s."""
    return observations[..., _COM_VELOCITY][..., :2]


def rotation(quaternions: Array) -> Array:
    """Rotation matrices, shape (..., 3, 3), of quaternions (w, x, y, z), shape (..., 4)."""
    w, x, y, z = np.moveaxis(
        quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True), -1, 0
    )
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def mirror_inputs(inputs: NDArray[np.floating]) -> NDArray[np.floating]:
    """The inputs with left and right exchanged, shape (..., 67)."""
    return inputs[..., INPUT_SOURCES] * INPUT_SIGNS


def mirror_action(action: NDArray[np.floating]) -> NDArray[np.floating]:
    """The action with left and right exchanged, shape (..., 21)."""
    return action[..., ACTION_SOURCES] * ACTION_SIGNS


_Mirror = tuple[list[int], list[int]]
"""Sources and signs: number i becomes `signs[i]` times the one in place `sources[i]`."""

_VECTOR: _Mirror = ([0, 1, 2], [1, -1, 1])
_AXIAL: _Mirror = ([0, 1, 2], [-1, 1, -1])  # an angular velocity
# Axes of these hinges are not each other's mirror images, so that their angles change sign.
_SIGN_CHANGES = {'abdomen_x', 'abdomen_z', 'ankle_x', 'shoulder1', 'shoulder2'}


def _mirror_names(names: tuple[str, ...]) -> _Mirror:
    other = {'left': 'right', 'right': 'left'}
    sources, signs = [], []
    for name in names:
        side, _, part = name.partition('_')
        swapped = f'{other[side]}_{part}' if side in other else name
        sources.append(names.index(swapped))
        signs.append(-1 if {name, part} & _SIGN_CHANGES else 1)
    return sources, signs


def _join(*blocks: _Mirror) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    sources: list[int] = []
    signs: list[int] = []
    for block_sources, block_signs in blocks:
        sources += [len(signs) + source for source in block_sources]
        signs += block_signs
    return np.array(sources), np.array(signs, np.float32)


_LIMBS_MIRROR: _Mirror = ([6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5], [1, -1, 1] * 4)
INPUT_SOURCES, INPUT_SIGNS = _join(
    _mirror_names(JOINTS),
    ([0], [1]),  # height of the head
    _VECTOR,  # the vertical
    _LIMBS_MIRROR,  # left hand and foot, right hand and foot
    _VECTOR,  # velocity
    _AXIAL,
    _mirror_names(JOINTS),  # velocities
    _VECTOR,  # direction
)
ACTION_SOURCES, ACTION_SIGNS = _join(_mirror_names(MOTORS))
