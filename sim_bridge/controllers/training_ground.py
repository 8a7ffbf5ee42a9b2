"""Training environment of the ant: an open floor."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_bridge.opengl import choose_opengl_library
from sim_bridge.simulator import Array


@dataclass(frozen=True, slots=True)
class TrackStep:
    """Outcome of one control step.

    Attributes:
        observation: The robot's own state without x and y, then the direction as (x, y).
        reward: Displacement along the direction, in metres.
        fallen: The robot fell and the episode is over.
        over: The episode is over, by a fall or by its step limit.
    """

    observation: Array
    reward: float
    fallen: bool
    over: bool


class TrainingGround:
    """OGBench's training environment for the ant: the direction is redrawn every 100 steps."""

    def __init__(self) -> None:
        """Load the physics."""
        choose_opengl_library()
        import gymnasium
        from ogbench.online_locomotion.wrappers import GymXYWrapper

        environment = gymnasium.make('online-ant-v0', disable_env_checker=True)
        self._env: Any = GymXYWrapper(environment, resample_interval=100)
        self.obs_dim = int(self._env.observation_space.shape[0])
        self.act_dim = int(self._env.action_space.shape[0])

    def reset(self, seed: int) -> Array:
        """Start an episode and return its first observation.

        OGBench's wrapper draws directions from NumPy's global generator, which this seeds.
        """
        np.random.seed(seed)
        observation, _ = self._env.reset(seed=seed)
        return observation

    def step(self, action: Array) -> TrackStep:
        """Apply an action, shape (act_dim,), each number within -1 to 1."""
        observation, reward, fallen, truncated, _ = self._env.step(action)
        return TrackStep(observation, float(reward), bool(fallen), bool(fallen or truncated))

    def close(self) -> None:
        """Free the physics."""
        self._env.close()
