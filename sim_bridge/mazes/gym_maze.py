"""Base of the mazes that wrap a gymnasium environment: episodes, limits and checks."""

from abc import abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.opengl import rendering_help
from sim_bridge.simulator import (
    Array,
    MazeDescription,
    Simulator,
    SimulatorError,
    StepResult,
)


class GymMaze(Simulator):
    """Tracks episode state; a subclass moves the robot.

    Subclasses set `_env`, whose `data` is MuJoCo's, start episodes in `reset` and `reset_free` by
    `_begin`, and implement `_advance`, `_move_goal` and `close`.
    """

    _env: Any

    def __init__(self, description: MazeDescription) -> None:
        """Start without an episode; `reset` begins one."""
        self.spec = description.spec
        self.maze = description.maze
        self.tasks = description.tasks
        self._running = False
        self._is_task = False
        self._has_goal = False
        self._num_steps = 0
        self._why_not_running = 'it was never reset'

    @abstractmethod
    def _advance(self, action: Array) -> tuple[Array, bool]:
        """Step the physics; returns the observation and whether the goal is reached.

        Args:
            action: Shape (act_dim,), each value in [-1, 1].
        """

    @abstractmethod
    def _move_goal(self, xy: Array) -> None:
        """Move the goal and its marker to (x, y), metres."""

    def step(self, action: ArrayLike) -> StepResult:
        """Apply an action for one control period; see `Simulator.step`."""
        self._check_running()
        observation, reached = self._advance(self._bounded(action))
        self._num_steps += 1
        success = self._has_goal and reached
        terminated = self._is_task and success
        truncated = self._is_task and self._num_steps >= self.spec.max_episode_steps
        if terminated or truncated:
            self._running = False
            ending = 'the goal was reached' if terminated else 'the step limit was reached'
            self._why_not_running = f'{ending} at step {self._num_steps}'
        return StepResult(observation, terminated, truncated, success)

    def set_goal(self, goal: ArrayLike) -> None:
        """Move the goal of the running episode; see `Simulator.set_goal`."""
        values = np.asarray(goal, dtype=np.float64)
        if values.shape not in ((2,), (self.spec.obs_dim,)):
            raise ValueError(
                f'goal must have shape (2,) or ({self.spec.obs_dim},), got {values.shape}'
            )
        if not np.isfinite(values).all():
            raise ValueError(f'goal must be finite, got {values.tolist()}')
        self._check_running()
        xy = values if values.shape == (2,) else values[list(self.spec.position_dims)]
        if not self.maze.contains(xy[0], xy[1]):
            raise ValueError(f'goal {xy.tolist()} lies outside the maze {self.maze.extent}')
        self._move_goal(xy.copy())
        self._has_goal = True

    @property
    def environment(self) -> Any:
        """The unwrapped gymnasium environment, for measurements."""
        return self._env

    @property
    def position(self) -> tuple[float, float]:
        """Current position of the robot, (x, y) in metres."""
        x, y = self._env.data.qpos[:2]
        return float(x), float(y)

    @property
    def qpos(self) -> Array:
        """Generalised positions of the physics, a copy."""
        return np.array(self._env.data.qpos)

    @property
    def qvel(self) -> Array:
        """Generalised velocities of the physics, a copy."""
        return np.array(self._env.data.qvel)

    def render(self) -> NDArray[np.uint8]:
        """Image of the maze from above; see `Simulator.render`."""
        import mujoco

        try:
            return self._draw()
        except (mujoco.FatalError, ImportError, RuntimeError, AttributeError) as error:
            # Which of these depends on the OpenGL library that is missing.
            raise SimulatorError(f'{rendering_help()} ({error})') from error

    def _draw(self) -> NDArray[np.uint8]:
        return np.asarray(self._env.render())

    def _begin(self, *, is_task: bool) -> None:
        """Begin an episode; one of a task has a goal from the start."""
        self._running = True
        self._num_steps = 0
        self._is_task = self._has_goal = is_task

    def _end(self, why: str) -> None:
        self._running = False
        self._why_not_running = why

    def _check_running(self) -> None:
        if not self._running:
            raise SimulatorError(f'no episode is running ({self._why_not_running}): call reset')

    def _check_start(self, start_xy: tuple[float, float] | None) -> None:
        if start_xy is not None and not self.maze.is_free(*start_xy):
            raise ValueError(f'start_xy {tuple(start_xy)} is not in a free cell of the maze')

    def _checked_task(self, task_id: int) -> int:
        is_number = isinstance(task_id, int | np.integer) and not isinstance(task_id, bool)
        if not is_number or not 1 <= task_id <= self.spec.num_tasks:
            raise ValueError(f'task_id must be from 1 to {self.spec.num_tasks}, got {task_id!r}')
        return int(task_id)

    def _bounded(self, action: ArrayLike) -> Array:
        """The action clipped to [-1, 1]."""
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (self.spec.act_dim,):
            raise ValueError(f'action must have shape ({self.spec.act_dim},), got {values.shape}')
        if np.abs(values).max() <= 1.0:  # false for NaN too
            return values
        if not np.isfinite(values).all():
            raise ValueError(f'action must be finite, got {values.tolist()}')
        return values.clip(-1.0, 1.0)


def check_seed(seed: int) -> None:
    """Refuse a seed that NumPy's generators do not accept.

    Raises:
        ValueError: If it is negative or needs more than 32 bits.
    """
    if not 0 <= seed < 2**32:
        raise ValueError(f'seed must be from 0 to {2**32 - 1}, got {seed}')
