"""Where direction followers learn: OGBench's robots on an open floor."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sim_bridge.opengl import choose_opengl_library
from sim_bridge.simulator import Array

Robot = Literal['ant', 'humanoid']


@dataclass(frozen=True, slots=True)
class TrackStep:
    """Outcome of one control step.

    Attributes:
        observation: The robot's own state without x and y, then the direction as (x, y).
        reward: For the ant the displacement along the direction, in metres.
        fallen: The robot fell and the episode is over.
        over: The episode is over, by a fall or by its step limit.
    """

    observation: Array
    reward: float
    fallen: bool
    over: bool


class TrainingGround:
    """OGBench's training environment for a robot: a floor and a direction that changes.

    The direction is redrawn every 100 steps (humanoid: 200).
    """

    def __init__(self, robot: Robot) -> None:
        """Load the physics."""
        choose_opengl_library()
        import gymnasium
        from ogbench.online_locomotion.wrappers import DMCHumanoidXYWrapper, GymXYWrapper

        environment = gymnasium.make(f'online-{robot}-v0', disable_env_checker=True)
        self._env: Any = (
            DMCHumanoidXYWrapper(environment, resample_interval=200)
            if robot == 'humanoid'
            else GymXYWrapper(environment, resample_interval=100)
        )
        self.robot = robot
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
