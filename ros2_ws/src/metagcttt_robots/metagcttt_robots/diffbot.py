"""Physics of a robot with two driven wheels and a caster, in MuJoCo. No ROS."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from metagcttt_robots.room import boxes, START

TIMESTEP_S = 0.002
WHEEL_RADIUS_M, TRACK_M = 0.06, 0.28
LIMITS = np.array([0.8, 2.5])
"""Fastest motion: m/s forward and back, rad/s to each side."""
ACCELERATIONS = np.array([2.0, 10.0])
COMMAND_TIMEOUT_S = 0.5
JOINTS = ('left_wheel_joint', 'right_wheel_joint')

_HEIGHT_M = WHEEL_RADIUS_M
_WHEEL = """
<body name="{side}" pos="0 {y} 0">
  <joint name="{side}_wheel_joint" axis="0 1 0" armature="0.002"/>
  <geom type="ellipsoid" size="{radius} 0.02 {radius}" mass="0.3" friction="1.5"/>
</body>"""
_MODEL = """
<mujoco>
  <option timestep="{timestep}" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="20 20 0.1"/>
    {obstacles}
    <body name="base" pos="0 0 {height}">
      <freejoint name="base"/>
      <geom type="cylinder" size="0.18 0.04" pos="0 0 0.05" mass="0.1" friction="0.05"/>
      <geom type="box" size="0.08 0.08 0.02" pos="-0.03 0 0" mass="4" contype="0" conaffinity="0"/>
      <geom type="sphere" size="0.03" pos="-0.13 0 -0.03" mass="0.1" condim="1"/>
      {wheels}
    </body>
  </worldbody>
  <actuator>
    <velocity joint="left_wheel_joint" kv="4" forcerange="-6 6"/>
    <velocity joint="right_wheel_joint" kv="4" forcerange="-6 6"/>
  </actuator>
</mujoco>"""


@dataclass(frozen=True)
class Motion:
    """Pose in the room (m, rad) and velocity of the robot (m/s, rad/s)."""

    x: float
    y: float
    yaw: float
    v: float
    w: float


class Diffbot:
    """The robot in its room. It limits speeds and accelerations and stops without commands."""

    def __init__(self) -> None:
        """Put it at the room's start."""
        obstacles = ''.join(
            f'<geom type="box" pos="{x} {y} 0.25" size="{a} {b} 0.25" friction="0.05"/>'
            for x, y, a, b in boxes()
        )
        wheels = ''.join(
            _WHEEL.format(side=side, y=y, radius=WHEEL_RADIUS_M)
            for side, y in (('left', TRACK_M / 2), ('right', -TRACK_M / 2))
        )
        self._model = mujoco.MjModel.from_xml_string(
            _MODEL.format(
                timestep=TIMESTEP_S, height=_HEIGHT_M, obstacles=obstacles, wheels=wheels
            )
        )
        self._data = mujoco.MjData(self._model)
        self._command = np.zeros(2)
        self._speed = np.zeros(2)
        self._commanded_s = -COMMAND_TIMEOUT_S
        self.place(*START)

    @property
    def time_s(self) -> float:
        """Simulated seconds."""
        return float(self._data.time)

    @property
    def motion(self) -> Motion:
        """Where it is and how it moves."""
        x, y, _, *(a, b, c, d) = self._data.qpos[:7]
        yaw = float(np.arctan2(2 * (a * d + b * c), 1 - 2 * (c * c + d * d)))
        vx, vy = self._data.qvel[:2]
        forward = vx * np.cos(yaw) + vy * np.sin(yaw)
        return Motion(float(x), float(y), yaw, float(forward), float(self._data.qvel[5]))

    @property
    def wheels(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Angles (rad) and speeds (rad/s) of the wheels, left first."""
        return self._data.qpos[7:9].copy(), self._data.qvel[6:8].copy()

    def place(self, x: float, y: float, yaw: float) -> None:
        """Put it somewhere, at rest."""
        self._data.qpos[:7] = x, y, _HEIGHT_M, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
        self._data.qvel[:] = 0
        self._speed[:] = self._command[:] = 0
        mujoco.mj_forward(self._model, self._data)

    def command(self, v: float, w: float) -> None:
        """Drive at v m/s and w rad/s, as far as it can, for `COMMAND_TIMEOUT_S`."""
        self._command = np.clip([v, w], -LIMITS, LIMITS)
        self._commanded_s = self.time_s

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds / TIMESTEP_S)):
            late = self.time_s - self._commanded_s > COMMAND_TIMEOUT_S
            wanted = np.zeros(2) if late else self._command
            reach = ACCELERATIONS * TIMESTEP_S
            self._speed += np.clip(wanted - self._speed, -reach, reach)
            v, w = self._speed
            turn = w * TRACK_M / 2
            self._data.ctrl[:] = (v - turn) / WHEEL_RADIUS_M, (v + turn) / WHEEL_RADIUS_M
            mujoco.mj_step(self._model, self._data)
