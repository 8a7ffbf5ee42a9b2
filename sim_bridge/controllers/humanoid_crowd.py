"""Many humanoids at once: what they see, and their physics for a resumed run."""

from typing import Any

import numpy as np

from sim_bridge.controllers.humanoid import OBS_DIM
from sim_bridge.simulator import Array


def observe(envs: list[Any]) -> tuple[Array, Array]:
    """Observations (n, 69) and the quaternions (w, x, y, z) of the torsos, (n, 4)."""
    observations = np.empty((len(envs), OBS_DIM))
    quaternions = np.empty((len(envs), 4))
    for index, env in enumerate(envs):
        observations[index] = env.get_ob()
        quaternions[index] = env.data.qpos[3:7]
    return observations, quaternions


def physics_states(envs: list[Any]) -> Array:
    """All that the next step of each depends on, one humanoid a row."""
    import mujoco

    size = mujoco.mj_stateSize(envs[0].model, mujoco.mjtState.mjSTATE_INTEGRATION)
    states = np.empty((len(envs), size))
    for env, row in zip(envs, states, strict=True):
        mujoco.mj_getState(env.model, env.data, row, mujoco.mjtState.mjSTATE_INTEGRATION)
    return states


def set_physics_states(envs: list[Any], states: Array) -> None:
    """Take over what `physics_states` gave."""
    import mujoco

    for env, row in zip(envs, states, strict=True):
        mujoco.mj_setState(env.model, env.data, row, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_step1(env.model, env.data)  # where OGBench's step ends
