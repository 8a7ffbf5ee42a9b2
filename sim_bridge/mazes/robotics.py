"""The point and ant mazes of gymnasium-robotics behind the simulator interface."""

from functools import cache
import math
import os
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.maze_map import Cell
from sim_bridge.mazes.gym_maze import check_seed, GymMaze
from sim_bridge.mazes.robotics_layouts import (
    flip,
    LAYOUTS,
    plan_of,
    ROBOTS,
    SUCCESS_M,
    task_cells,
)
from sim_bridge.opengl import choose_opengl_library
from sim_bridge.simulator import Array, Family, MazeDescription, SimulatorSpec, Task

_PICTURE_PIXELS = 200
_PICTURE_MARGIN = 1.1
_NAME = re.compile(r'(?P<family>PointMaze|AntMaze)_(?P<layout>\w+)-(?P<version>v\d)')


def names() -> tuple[str, ...]:
    """Names of the mazes, as the package registers them, such as `PointMaze_Medium-v3`."""
    return tuple(
        f'{family}_{layout}-{version}' for family, version in ROBOTS for layout in LAYOUTS
    )


def canonical_name(name: str) -> str | None:
    """The name itself, or None when it is not one of `names`."""
    return name if name in names() else None


@cache
def describe(name: str) -> MazeDescription:
    """Spec, plan and tasks of one of the `names`, without loading the physics."""
    family, layout, version = _parts(name)
    robot = ROBOTS[family, version]
    maze = plan_of(layout, robot.unit_m)
    tasks = tuple(
        Task(number, f'task{number}', maze.center(*start), maze.center(*goal))
        for number, (start, goal) in enumerate(task_cells(layout, maze), start=1)
    )
    spec = SimulatorSpec(
        name=name,
        obs_dim=robot.obs_dim,
        act_dim=robot.act_dim,
        max_episode_steps=robot.max_episode_steps[layout.split('_')[0]],
        control_period_s=robot.control_period_s,
        goal_tolerance_m=SUCCESS_M,
        num_tasks=len(tasks),
    )
    return MazeDescription(spec=spec, maze=maze, tasks=tasks)


class RoboticsMaze(GymMaze):
    """One maze of gymnasium-robotics, stepped through the package's own environment.

    Observations are its dictionaries as vectors that begin with x and y: those of the point are
    its `observation` (x, y and velocities), those of the ant its `achieved_goal` followed by its
    `observation`. The observation of a goal is that of the robot's first pose, at the goal.

    An episode of a task that was reset with a seed starts as the package's environment does after
    `env.reset(seed=seed, options={'reset_cell': ..., 'goal_cell': ...})`. Its rule of success
    (within 0.45 m of the goal) is kept; the task's episode ends there.
    """

    def __init__(self, name: str) -> None:
        """Load the physics of one of the `names`."""
        super().__init__(describe(name))
        _, self._layout, _ = _parts(name)
        self._is_ant = name.startswith('Ant')
        self._env = _make_environment(name)
        self._rng = np.random.default_rng(0)
        self._next_seed: int | None = 0
        self._renderer: Any = None

    def reset(self, task_id: int | None = None, seed: int | None = None) -> tuple[Array, Array]:
        """Start an episode of a task; see `Simulator.reset`."""
        if task_id is not None:
            task_id = self._checked_task(task_id)
        self._seed(seed)
        if task_id is None:
            task_id = int(self._rng.integers(self.spec.num_tasks)) + 1
        task = self.tasks[task_id - 1]
        observation = self._place(self.maze.cell(*task.start_xy), self.maze.cell(*task.goal_xy))
        self._begin(is_task=True)
        return observation, np.concatenate([self._env.goal, observation[2:]])

    def reset_free(
        self, seed: int | None = None, start_xy: tuple[float, float] | None = None
    ) -> Array:
        """Start an episode that never ends; see `Simulator.reset_free`."""
        self._check_start(start_xy)
        self._seed(seed)
        if start_xy is None:
            free_cells = self.maze.free_cells()
            cell = free_cells[self._rng.integers(len(free_cells))]
        else:
            cell = self.maze.cell(*start_xy)
        observation = self._place(cell, cell)
        self._begin(is_task=False)
        if start_xy is not None:
            qpos = self.qpos
            qpos[:2] = start_xy
            self._robot.set_state(qpos, self.qvel)
            observation[:2] = start_xy
        return observation

    def close(self) -> None:
        """Free the physics and the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self._env.close()
        self._end('the simulator is closed')

    def _advance(self, action: Array) -> tuple[Array, bool]:
        observation, _, reached, _, _ = self._env.step(action)
        return self._vector(observation), bool(reached)

    def _move_goal(self, xy: Array) -> None:
        self._env.goal = xy
        self._env.update_target_site_pos()

    def _draw(self) -> NDArray[np.uint8]:
        """From straight above, y up; the package's own cameras follow the robot."""
        import mujoco

        if self._renderer is None:
            self._renderer = mujoco.Renderer(self._env.model, _PICTURE_PIXELS, _PICTURE_PIXELS)
        camera = mujoco.MjvCamera()
        camera.lookat[:] = 0.0
        camera.azimuth, camera.elevation = 90.0, -90.0
        xmin, xmax, ymin, ymax = self.maze.extent
        half_angle = math.radians(self._env.model.vis.global_.fovy / 2)
        camera.distance = (
            _PICTURE_MARGIN * max(xmax - xmin, ymax - ymin) / 2 / math.tan(half_angle)
        )
        self._renderer.update_scene(self._env.data, camera)
        return self._renderer.render()

    def _place(self, start: Cell, goal: Cell) -> Array:
        options = {
            'reset_cell': flip(self._layout, start),
            'goal_cell': flip(self._layout, goal),
        }
        seed, self._next_seed = self._next_seed, None
        observation, _ = self._env.reset(seed=seed, options=options)
        return self._vector(observation)

    def _vector(self, observation: dict[str, Array]) -> Array:
        if self._is_ant:
            return np.concatenate([observation['achieved_goal'], observation['observation']])
        return observation['observation']

    @property
    def _robot(self) -> Any:
        return self._env.ant_env if self._is_ant else self._env.point_env

    def _seed(self, seed: int | None) -> None:
        if seed is None:
            return
        check_seed(seed)
        self._rng = np.random.default_rng(seed)
        self._next_seed = seed


FAMILY = Family(names, canonical_name, describe, RoboticsMaze)


def _parts(name: str) -> tuple[str, str, str]:
    """Family, layout and version of one of the `names`."""
    match = _NAME.fullmatch(name)
    assert match is not None, name
    return match['family'], match['layout'], match['version']


def _make_environment(name: str) -> Any:
    """The package's environment without gymnasium's wrappers; the simulator does their work.

    `continuing_task=False` makes it tell when the goal is reached, and leaves the goal in place.
    """
    choose_opengl_library()
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    environment: Any = gymnasium.make(
        name, disable_env_checker=True, continuing_task=False
    ).unwrapped
    # The package writes the model to a temporary file, loads it, and leaves it behind.
    os.unlink(environment.tmp_xml_file_path)
    return environment
