"""OGBench's point, ant and humanoid mazes behind the simulator interface."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
import math
from pathlib import Path
import re
from typing import Any

import numpy as np

from sim_bridge.maze_map import MazeMap
from sim_bridge.mazes.gym_maze import check_seed, GymMaze
from sim_bridge.mazes.ogbench_layouts import (
    LAYOUTS,
    ORIGIN_XY,
    ROBOTS,
    TASK_CELLS,
    UNIT_M,
)
from sim_bridge.opengl import choose_opengl_library
from sim_bridge.simulator import Array, Family, MazeDescription, SimulatorSpec, Task

_DATASET_NAME = re.compile(r'(?P<maze>\w+-\w+)-(navigate|stitch|explore)-v0')

STANDING_Z_M = 1.3
"""Height of a humanoid's torso with straight legs and the feet just above the floor."""
_JOINT_NOISE_RAD = 0.08

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


class OGBenchMaze(GymMaze):
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
        super().__init__(describe(name))
        self._env = make_environment(name)
        self._is_humanoid = name.startswith('humanoidmaze')
        self._standing = False
        teleports = self._env._teleport_info or {'teleport_in_xys': []}
        self._teleport_xys = teleports['teleport_in_xys']
        self._noise = np.random.RandomState(0)
        self._env.action_space.seed(0)
        self._first_seed: int | None = 0

    def reset(self, task_id: int | None = None, seed: int | None = None) -> tuple[Array, Array]:
        """Start an episode of a task; see `Simulator.reset`."""
        options = {} if task_id is None else {'task_id': self._checked_task(task_id)}
        self._show_goal(True)
        observation, goal = self._reset(seed, options)
        if self._standing:
            start_xy = np.array(self.position)
            self._env.set_xy(goal[:2])
            goal = self.stand()
            self._env.set_xy(start_xy)
            observation = self.stand()
        self._begin(is_task=True)
        return observation, goal

    def start_standing(self) -> None:
        """Show a humanoid on its feet at starts and goals; see `Simulator.start_standing`.

        Starts and goals are where OGBench's are, the turns of the torso are random.
        """
        if not self._is_humanoid:
            super().start_standing()
        self._standing = True

    def reset_free(
        self, seed: int | None = None, start_xy: tuple[float, float] | None = None
    ) -> Array:
        """Start an episode that never ends; see `Simulator.reset_free`."""
        self._check_start(start_xy)
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
        self._begin(is_task=False)
        if start_xy is not None:
            self._env.set_xy(np.array(start_xy, dtype=np.float64))
            observation = self._env.get_ob()
        return self.stand() if self._standing else observation

    def stand(self) -> Array:
        """Put the humanoid on its feet where it is and return the observation.

        OGBench starts its tasks with a humanoid in a random pose that falls to the floor. Other
        robots start upright and are left as they are.
        """
        if self._is_humanoid:
            qpos, _ = standing_pose(self.position, self._noise)
            self._env.set_state(qpos, np.zeros(self._env.model.nv))
        return np.array(self._env.get_ob())

    def close(self) -> None:
        """Free the physics and the renderer."""
        if self._env.custom_renderer is not None:
            self._env.custom_renderer.close()
            self._env.custom_renderer = None
        self._env.close()
        self._end('the simulator is closed')

    def _advance(self, action: Array) -> tuple[Array, bool]:
        with self._own_noise() if self._is_near_teleport() else nullcontext():
            observation, _, reached, _, _ = self._env.step(action)
        return observation, bool(reached)

    def _move_goal(self, xy: Array) -> None:
        self._env.set_goal(goal_xy=xy)
        self._show_goal(True)

    def _reset(self, seed: int | None, options: dict[str, Any]) -> tuple[Array, Array]:
        self._seed(seed)
        first_seed, self._first_seed = self._first_seed, None
        with self._own_noise():
            observation, info = self._env.reset(seed=first_seed, options=options)
        return observation, np.array(info['goal'], dtype=np.float64)

    def _show_goal(self, shown: bool) -> None:
        """Put the goal's marker on the floor or under it; pictures show it from the next step."""
        self._env.model.geom('target').pos[2] = 0.05 if shown else -1.0

    def _seed(self, seed: int | None) -> None:
        if seed is None:
            return
        check_seed(seed)
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
        """True if the next step may end in a teleport, whose exit is random."""
        return any(math.dist(self.position, xy) <= _TELEPORT_REACH_M for xy in self._teleport_xys)


FAMILY = Family(names, canonical_name, describe, OGBenchMaze)


def standing_pose(
    xy: tuple[float, float], rng: np.random.Generator | np.random.RandomState
) -> tuple[Array, float]:
    """Generalised positions, shape (28,), of a humanoid that stands, and its yaw in radians.

    The yaw is drawn uniformly; the joints are near their middle.
    """
    yaw = rng.uniform(-math.pi, math.pi)
    joints = rng.normal(0.0, _JOINT_NOISE_RAD, 21)
    quaternion = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    return np.concatenate([xy, (STANDING_Z_M,), quaternion, joints]), float(yaw)


def make_environment(name: str) -> Any:
    """OGBench's environment without gymnasium's wrappers; the simulator does their work."""
    choose_opengl_library()
    import gymnasium
    import ogbench.locomaze  # registers the environments  # noqa: F401

    environment: Any = gymnasium.make(name, disable_env_checker=True).unwrapped
    # OGBench writes the model to a temporary file, loads it, and leaves it behind.
    Path(environment.fullpath).unlink()
    return environment


def open_floor(robot: str) -> Any:
    """OGBench's `ant` or `humanoid` on a floor without walls, without gymnasium's wrappers."""
    choose_opengl_library()
    from ogbench.locomaze.ant import AntEnv
    from ogbench.locomaze.humanoid import HumanoidEnv

    return {'ant': AntEnv, 'humanoid': HumanoidEnv}[robot]()
