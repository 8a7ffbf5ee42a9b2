"""Physics of an arm with four position-controlled joints beside a post, in MuJoCo. No ROS."""

import mujoco
import numpy as np
from numpy.typing import NDArray

TIMESTEP_S = 0.002
JOINTS = ('pan_joint', 'lift_joint', 'elbow_joint', 'wrist_joint')
LOW = np.array([-1.6, -0.2, -2.2, -1.5])
HIGH = np.array([1.6, 1.4, 0.2, 1.5])
"""Limits of the joints, rad; lift 0 is level, above it is up."""
HOME = np.array([-1.0, 0.6, -1.0, 0.0])
SPEED = 1.5
"""Fastest change of a joint's target, rad/s."""

_MODEL = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{timestep}" integrator="implicitfast"/>
  <default>
    <joint damping="2" armature="0.05"/>
    <geom type="capsule" friction="0.3"/>
    <position kp="120" kv="8" forcerange="-60 60"/>
  </default>
  <worldbody>
    <geom type="box" pos="0.45 0 0.2" size="0.05 0.05 0.2"/>
    <body pos="0 0 0.3" gravcomp="1">
      <joint name="pan_joint" axis="0 0 1" range="-1.6 1.6" limited="true"/>
      <geom type="cylinder" size="0.05 0.05" mass="1"/>
      <body gravcomp="1">
        <joint name="lift_joint" axis="0 -1 0" range="-0.2 1.4" limited="true"/>
        <geom fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
        <body pos="0.3 0 0" gravcomp="1">
          <joint name="elbow_joint" axis="0 -1 0" range="-2.2 0.2" limited="true"/>
          <geom fromto="0 0 0 0.25 0 0" size="0.025" mass="0.6"/>
          <body pos="0.25 0 0" gravcomp="1">
            <joint name="wrist_joint" axis="0 -1 0" range="-1.5 1.5" limited="true"/>
            <geom fromto="0 0 0 0.08 0 0" size="0.02" mass="0.2"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>"""


class Arm:
    """The arm. Its joints follow their targets no faster than `SPEED` and hold the last ones."""

    def __init__(self) -> None:
        """Put it at home."""
        actuators = ''.join(f'<position joint="{joint}"/>' for joint in JOINTS)
        self._model = mujoco.MjModel.from_xml_string(
            _MODEL.format(timestep=TIMESTEP_S, actuators=actuators)
        )
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = self._data.ctrl[:] = self._target = HOME.copy()
        mujoco.mj_forward(self._model, self._data)

    @property
    def joints(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (rad) and speeds (rad/s) in the order of `JOINTS`."""
        return self._data.qpos.copy(), self._data.qvel.copy()

    def command(self, target: NDArray[np.float64]) -> None:
        """Move to these positions, within the limits."""
        self._target = np.clip(target, LOW, HIGH)

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        reach = SPEED * TIMESTEP_S
        for _ in range(round(seconds / TIMESTEP_S)):
            self._data.ctrl[:] += np.clip(self._target - self._data.ctrl, -reach, reach)
            mujoco.mj_step(self._model, self._data)
