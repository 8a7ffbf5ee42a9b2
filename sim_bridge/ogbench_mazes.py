"""OGBench's point, ant and humanoid mazes behind the simulator interface."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
import math
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.maze_map import MazeMap
from sim_bridge.ogbench_layouts import (
    LAYOUTS,
    ORIGIN_XY,
    ROBOTS,
    TASK_CELLS,
    UNIT_M,
)
from sim_bridge.rendering import choose_opengl_library, rendering_help
from sim_bridge.simulator import (
    Array,
    MazeDescription,
    Simulator,
    SimulatorError,
    SimulatorSpec,
    StepResult,
    Task,
)

_DATASET_NAME = re.compile(r'(?P<maze>\w+-\w+)-(navigate|stitch|explore)-v0')

# Teleports take what is within 1.5 m of their center after a step; no robot moves 2 m in a step.
_TELEPORT_REACH_M = 3.5


def names() -> tuple[str, ...]:
    """Names of the mazes, such as `pointmaze-medium-v0`."""
    return tuple(
        f'{robot}-{layout}-v0' for robot, facts in ROBOTS.items() for layout in facts.layouts
    )


def canonical_name(name: str) -> str | None:
    """The maze that `name` stands for, or None when it is not one of OGBench's.

    Names of OGBench's datasets stand for the maze they were made in.

    Example:
        >>> canonical_name('pointmaze-medium-navigate-v0')
        'pointmaze-medium-v0'
    """
    match = _DATASET_NAME.fullmatch(name)
    maze = f'{match["maze"]}-v0' if match else name
    return maze if maze in names() else None


@cache
def describe(name: str) -> MazeDescription:
    """Spec, plan and tasks of one of the `names`, without loading the physics."""
    robot_name, layout, _ = name.split('-')
    robot = ROBOTS[robot_name]
    maze = MazeMap.from_rows(LAYOUTS[layout], unit_m=UNIT_M, origin_xy=ORIGIN_XY)
    tasks = tuple(
        Task(number, f'task{number}', maze.center(*start), maze.center(*goal))
        for number, (start, goal) in enumerate(TASK_CELLS[layout], start=1)
    )
    spec = SimulatorSpec(
        name=name,
        obs_dim=robot.obs_dim,
        act_dim=robot.act_dim,
        max_episode_steps=robot.max_episode_steps[layout],
        control_period_s=robot.control_period_s,
        goal_tolerance_m=robot.goal_tolerance_m,
        num_tasks=len(tasks),
    )
    return MazeDescription(spec=spec, maze=maze, tasks=tasks)


class OGBenchMaze(Simulator):
    """One OGBench maze, stepped through the package's own gymnasium environment.

    `reset(task_id, seed)` gives what OGBench's environment gives after seeding all three random
    sources that its reset reads: `np.random.seed(seed)`, `env.action_space.seed(seed)` and
    `env.reset(seed=seed, options={'task_id': task_id})`. OGBench draws the noise around starts
    and goals (and the exits of teleports) from NumPy's global generator; here it comes from a
    generator of this simulator, put in the global one's place for the length of the call.
    A simulator is meant to be used from one thread at a time.

    In the teleport mazes the observation of a step that ends in a teleport is, as in OGBench, the
    one before the jump; `position` and the next observation are after it.
    """

    def __init__(self, name: str) -> None:
        """Load the physics of one of the `names`."""
        description = describe(name)
        self.spec = description.spec
        self.maze = description.maze
        self.tasks = description.tasks
        self._env = _make_environment(name)
        teleports = self._env._teleport_info or {'teleport_in_xys': []}
        self._teleport_xys = teleports['teleport_in_xys']
        self._noise = np.random.RandomState(0)
        self._env.action_space.seed(0)
        self._first_seed: int | None = 0
        self._running = False
        self._is_task = False
        self._has_goal = False
        self._num_steps = 0
        self._why_not_running = 'it was never reset'

    def reset(self, task_id: int | None = None, seed: int | None = None) -> tuple[Array, Array]:
        """Start an episode of a task; see `Simulator.reset`."""
        options = {} if task_id is None else {'task_id': self._checked_task(task_id)}
        self._show_goal(True)
        observation, goal = self._reset(seed, options)
        self._is_task = self._has_goal = True
        return observation, goal

    def reset_free(
        self, seed: int | None = None, start_xy: tuple[float, float] | None = None
    ) -> Array:
        """Start an episode that never ends; see `Simulator.reset_free`."""
        if start_xy is not None and not self.maze.is_free(*start_xy):
            raise ValueError(f'start_xy {tuple(start_xy)} is not in a free cell of the maze')
        self._seed(seed)
        if start_xy is None:
            free_cells = self.maze.free_cells()
            cell = free_cells[self._noise.randint(len(free_cells))]
        else:
            cell = self.maze.cell(*start_xy)
        # A task of our own that starts and ends in this cell gives the robot OGBench's start pose.
        task_info = {'init_ij': cell, 'goal_ij': cell}
        self._show_goal(False)
        observation, _ = self._reset(None, {'task_info': task_info})
        self._is_task = self._has_goal = False
        if start_xy is not None:
            self._env.set_xy(np.array(start_xy, dtype=np.float64))
            observation = self._env.get_ob()
        return observation

    def step(self, action: ArrayLike) -> StepResult:
        """Apply an action for one control period; see `Simulator.step`."""
        if not self._running:
            raise SimulatorError(f'no episode is running ({self._why_not_running}): call reset')
        values = self._checked_action(action)
        bounded = values.clip(-1.0, 1.0)
        with self._own_noise() if self._is_near_teleport() else nullcontext():
            observation, _, reached, _, _ = self._env.step(bounded)
        self._num_steps += 1
        success = self._has_goal and bool(reached)
        terminated = self._is_task and success
        truncated = self._is_task and self._num_steps >= self.spec.max_episode_steps
        if terminated or truncated:
            self._running = False
            ending = 'the goal was reached' if terminated else 'the step limit was reached'
            self._why_not_running = f'{ending} at step {self._num_steps}'
        clipped = bool((values != bounded).any())
        return StepResult(observation, terminated, truncated, success, clipped)

    def set_goal(self, goal: ArrayLike) -> None:
        """Move the goal of the running episode; see `Simulator.set_goal`."""
        values = np.asarray(goal, dtype=np.float64)
        if values.shape not in ((2,), (self.spec.obs_dim,)):
            raise ValueError(
                f'goal must have shape (2,) or ({self.spec.obs_dim},), got {values.shape}'
            )
        if not np.isfinite(values).all():
            raise ValueError(f'goal must be finite, got {values.tolist()}')
        if not self._running:
            raise SimulatorError(f'no episode is running ({self._why_not_running}): call reset')
        xy = values if values.shape == (2,) else values[list(self.spec.position_dims)]
        if not self.maze.contains(xy[0], xy[1]):
            raise ValueError(f'goal {xy.tolist()} lies outside the maze {self.maze.extent}')
        self._env.set_goal(goal_xy=xy.copy())
        self._show_goal(True)
        self._has_goal = True

    @property
    def position(self) -> tuple[float, float]:
        """Where the robot is now, (x, y) in metres."""
        x, y = self._env.get_xy()
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
        """Picture of the maze from above; see `Simulator.render`."""
        import mujoco

        try:
            return np.asarray(self._env.render())
        except (mujoco.FatalError, ImportError, RuntimeError, AttributeError) as error:
            # One of these, depending on which OpenGL library is missing and how.
            raise SimulatorError(f'{rendering_help()} ({error})') from error

    def close(self) -> None:
        """Free the physics and the renderer."""
        if self._env.custom_renderer is not None:
            self._env.custom_renderer.close()
            self._env.custom_renderer = None
        self._env.close()
        self._running = False
        self._why_not_running = 'the simulator is closed'

    def _reset(self, seed: int | None, options: dict[str, Any]) -> tuple[Array, Array]:
        self._seed(seed)
        first_seed, self._first_seed = self._first_seed, None
        with self._own_noise():
            observation, info = self._env.reset(seed=first_seed, options=options)
        self._running = True
        self._num_steps = 0
        return observation, np.array(info['goal'], dtype=np.float64)

    def _show_goal(self, shown: bool) -> None:
        """Put the goal's marker on the floor or under it; pictures show it from the next step."""
        self._env.model.geom('target').pos[2] = 0.05 if shown else -1.0

    def _seed(self, seed: int | None) -> None:
        if seed is None:
            return
        if not 0 <= seed < 2**32:
            raise ValueError(f'seed must be from 0 to {2**32 - 1}, got {seed}')
        self._noise.seed(seed)
        self._env.action_space.seed(seed)
        self._first_seed = seed

    @contextmanager
    def _own_noise(self) -> Iterator[None]:
        """Let OGBench's draws from NumPy's global generator come from this simulator's."""
        outside = np.random.get_state()
        np.random.set_state(self._noise.get_state())
        try:
            yield
        finally:
            self._noise.set_state(np.random.get_state())
            np.random.set_state(outside)

    def _is_near_teleport(self) -> bool:
        """Whether the next step might end in a teleport, whose exit is drawn at random."""
        return any(math.dist(self.position, xy) <= _TELEPORT_REACH_M for xy in self._teleport_xys)

    def _checked_task(self, task_id: int) -> int:
        is_number = isinstance(task_id, int | np.integer) and not isinstance(task_id, bool)
        if not is_number or not 1 <= task_id <= self.spec.num_tasks:
            raise ValueError(f'task_id must be from 1 to {self.spec.num_tasks}, got {task_id!r}')
        return int(task_id)

    def _checked_action(self, action: ArrayLike) -> Array:
        values = np.asarray(action, dtype=np.float64)
        if values.shape != (self.spec.act_dim,):
            raise ValueError(f'action must have shape ({self.spec.act_dim},), got {values.shape}')
        if not np.isfinite(values).all():
            raise ValueError(f'action must be finite, got {values.tolist()}')
        return values


def _make_environment(name: str) -> Any:
    """OGBench's environment without gymnasium's wrappers; the simulator does their work."""
    choose_opengl_library()
    import gymnasium
    import ogbench.locomaze  # registers the environments  # noqa: F401

    environment: Any = gymnasium.make(name, disable_env_checker=True).unwrapped
    # OGBench writes the model to a temporary file, loads it, and leaves it behind.
    Path(environment.fullpath).unlink()
    return environment
