"""The simulator interface: every maze implements it."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.maze_map import MazeMap

Array = NDArray[np.float64]


class SimulatorError(RuntimeError):
    """A simulator was used out of order, or on a machine that cannot run it."""


@dataclass(frozen=True)
class SimulatorSpec:
    """Static properties of a simulator, known without running it.

    Attributes:
        name: Name that `make_simulator` takes.
        obs_dim: Length of an observation.
        act_dim: Length of an action, each value in [-1, 1].
        max_episode_steps: Control steps after which a task episode is truncated.
        control_period_s: Simulated seconds per control step.
        goal_tolerance_m: A task is solved within this distance of its goal, in metres.
        num_tasks: Evaluation tasks, numbered from 1.
        position_dims: Indices of x and y, in metres, in an observation.
    """

    name: str
    obs_dim: int
    act_dim: int
    max_episode_steps: int
    control_period_s: float
    goal_tolerance_m: float
    num_tasks: int
    position_dims: tuple[int, int] = (0, 1)


@dataclass(frozen=True)
class Task:
    """One evaluation task; every reset adds noise to its start and goal.

    Attributes:
        task_id: Number of the task, from 1.
        name: Short name, such as `task1`.
        start_xy: Centre of the start cell, (x, y) in metres.
        goal_xy: Centre of the goal cell, (x, y) in metres.
    """

    task_id: int
    name: str
    start_xy: tuple[float, float]
    goal_xy: tuple[float, float]


@dataclass(frozen=True)
class MazeDescription:
    """Description of a maze without its physics."""

    spec: SimulatorSpec
    maze: MazeMap
    tasks: tuple[Task, ...]


@dataclass(frozen=True, slots=True)
class StepResult:
    """Outcome of one control step.

    Attributes:
        observation: Observation after the step, shape (obs_dim,), float64.
        terminated: The task's goal is reached; the episode is over.
        truncated: The step limit of the task episode is reached; the episode is over.
        success: The position is within the tolerance of the current goal.
    """

    observation: Array
    terminated: bool
    truncated: bool
    success: bool


class Simulator(ABC):
    """One robot in one maze.

    `reset` starts an episode of a task, which ends on success or at the step limit;
    `reset_free` starts one without a task, which never ends. All randomness derives from the
    seed given there. Without a seed the random streams continue (they start at seed 0), so a
    program that resets in the same order sees the same episodes.

    Positions are in metres in the maze frame: x to the right and y up on its plan.
    """

    spec: SimulatorSpec
    maze: MazeMap
    tasks: tuple[Task, ...]

    @abstractmethod
    def reset(self, task_id: int | None = None, seed: int | None = None) -> tuple[Array, Array]:
        """Start an episode of a task and return its first observation and its goal.

        Args:
            task_id: Task from 1 to `spec.num_tasks`; None draws one.
            seed: Random seed of the start, the goal and the episode.

        Returns:
            Observation and goal observation, both of shape (obs_dim,), float64.

        Raises:
            ValueError: If there is no such task or the seed is negative.
        """

    def start_standing(self) -> None:
        """Show the robot on its feet at the start and the goal of every task from now on.

        Raises:
            ValueError: If it starts its tasks on its feet anyway: only humanoids do not.
        """
        raise ValueError(f'{self.spec.name}: only humanoids have a standing start')

    @abstractmethod
    def reset_free(
        self, seed: int | None = None, start_xy: tuple[float, float] | None = None
    ) -> Array:
        """Start an episode without a task, which never ends, and return its first observation.

        A humanoid stands on its feet, unlike in OGBench, which drops it in a random pose.

        `step` reports neither `terminated` nor `truncated` in it. There is no goal until
        `set_goal` gives one; from then on `success` tells whether the robot is at it.

        Args:
            seed: Random seed of the start and the episode.
            start_xy: Start position in metres; None draws one near the centre of a free cell.

        Returns:
            Observation of shape (obs_dim,), float64.

        Raises:
            ValueError: If `start_xy` is not in a free cell or the seed is negative.
        """

    @abstractmethod
    def step(self, action: ArrayLike) -> StepResult:
        """Apply an action for one control period.

        Args:
            action: Shape (act_dim,); clipped to [-1, 1], as OGBench's evaluation does.

        Raises:
            ValueError: If the action has another shape or is not finite; nothing moves then.
            SimulatorError: If no episode is running.
        """

    @abstractmethod
    def set_goal(self, goal: ArrayLike) -> None:
        """Move the goal of the running episode.

        Args:
            goal: A point (x, y) in metres or an observation of shape (obs_dim,).

        Raises:
            ValueError: If the goal has another shape, is not finite or is outside the maze.
            SimulatorError: If no episode is running.
        """

    @property
    @abstractmethod
    def position(self) -> tuple[float, float]:
        """Current position of the robot, (x, y) in metres."""

    @property
    @abstractmethod
    def qpos(self) -> Array:
        """Generalised positions of the physics, a copy."""

    @property
    @abstractmethod
    def qvel(self) -> Array:
        """Generalised velocities of the physics, a copy."""

    @abstractmethod
    def render(self) -> NDArray[np.uint8]:
        """Image of the maze from above, shape (height, width, 3).

        Raises:
            SimulatorError: If this machine cannot render; says what to set.
        """

    @abstractmethod
    def close(self) -> None:
        """Free the physics and the renderer; the simulator cannot be used afterwards."""

    def __enter__(self) -> 'Simulator':
        """Return itself, to be closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


@dataclass(frozen=True)
class Family:
    """The simulators of one module.

    Attributes:
        names: Returns the names of its mazes.
        canonical_name: Maps any accepted spelling to one of the names, others to None.
        describe: Returns spec, plan and tasks of a named maze, without physics.
        make: Builds the simulator of a named maze.
    """

    names: Callable[[], tuple[str, ...]]
    canonical_name: Callable[[str], str | None]
    describe: Callable[[str], MazeDescription]
    make: Callable[[str], Simulator]
