"""Walks of a learned controller on an open floor and through mazes, to see how good it is."""

from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from sim_bridge.controllers.follower import DirectionFollower
from sim_bridge.controllers.humanoid import head_height
from sim_bridge.controllers.humanoid_get_up import STANDING_HEAD_M
from sim_bridge.controllers.learned import LearnedFollower
from sim_bridge.controllers.posture import count_falls, has_fallen
from sim_bridge.mazes.ogbench import OGBenchMaze, open_floor, standing_pose
from sim_bridge.simulator import Array

TURN_EVERY_S = 2.5
QUARTER_TURNS_RAD = (0.0, math.pi / 2, -math.pi / 2)


@dataclass(frozen=True)
class Walk:
    """One walk along given directions.

    Attributes:
        directions: Unit vectors (x, y), one a control step, shape (T, 2).
        qpos: Generalised positions from the first to the last, shape (T + 1, nq).
        falls: How often the robot fell.
        period_s: Seconds per control step.
    """

    directions: Array
    qpos: Array
    falls: int
    period_s: float

    @property
    def direction(self) -> Array:
        """The first direction."""
        return self.directions[0]

    @property
    def path(self) -> Array:
        """Positions (x, y), metres, shape (T + 1, 2)."""
        return self.qpos[:, :2]

    @property
    def duration_s(self) -> float:
        """Simulated seconds."""
        return self.period_s * len(self.directions)

    @property
    def distance_m(self) -> float:
        """Metres along the directions."""
        return float((np.diff(self.path, axis=0) * self.directions).sum())

    @property
    def drift_m(self) -> float:
        """Metres to the left of the directions."""
        left = np.stack([-self.directions[:, 1], self.directions[:, 0]], axis=-1)
        return float((np.diff(self.path, axis=0) * left).sum())

    @property
    def speed(self) -> float:
        """Mean speed along the directions, metres per second."""
        return self.distance_m / self.duration_s


def walk_along(
    follower: LearnedFollower,
    direction: Array,
    duration_s: float,
    seed: int,
    turns_rad: tuple[float, ...] = (),
    action_noise: float = 0.0,
) -> Walk:
    """Walk on an open floor from a random start pose; a fall does not end the walk.

    A fallen humanoid is put on its feet where it lies, as it cannot get up.

    Args:
        follower: The controller.
        direction: Unit vector (x, y) to start along.
        duration_s: Simulated seconds.
        seed: Random seed of the poses, the turns and the noise.
        turns_rad: Every `TURN_EVERY_S` the direction turns by one of these angles, drawn at
            random; none keeps it.
        action_noise: Standard deviation of what is added to the actions.
    """
    environment = open_floor(follower.robot)
    environment.reset(seed=seed)
    rng = np.random.default_rng(seed)
    is_humanoid = follower.robot == 'humanoid'
    if is_humanoid:
        _stand_up(environment, rng)
    turn_steps = round(TURN_EVERY_S / environment.dt)
    qpos, directions, falls = [environment.data.qpos.copy()], [], 0
    for step in range(round(duration_s / environment.dt)):
        if turns_rad and step > 0 and step % turn_steps == 0:
            direction = turned(direction, rng.choice(turns_rad))
        action = follower.act(environment.get_ob(), direction, qpos[-1])
        if action_noise > 0:
            action = (action + rng.normal(0.0, action_noise, action.shape)).clip(-1, 1)
        environment.do_simulation(action, environment.frame_skip)
        if is_humanoid and has_fallen(environment.data.qpos):
            falls += 1
            _stand_up(environment, rng)
        directions.append(direction)
        qpos.append(environment.data.qpos.copy())
    environment.close()
    positions = np.array(qpos)
    falls = falls if is_humanoid else count_falls(positions)
    return Walk(np.array(directions), positions, falls, environment.dt)


@dataclass(frozen=True)
class GoalRun:
    """One task of a maze, walked until the goal, the step limit or, started upright, a fall.

    Attributes:
        reached: The goal was reached.
        falls: How often the robot fell on the way; dropped, the first time is the drop.
        duration_s: Simulated seconds.
    """

    reached: bool
    falls: int
    duration_s: float


def walk_to_goal(
    follower: DirectionFollower,
    maze: OGBenchMaze,
    task_id: int,
    seed: int,
    action_noise: float,
    dropped: bool = False,
) -> GoalRun:
    """Walk a task along the shortest way through the cells.

    The robot starts upright and ends with its first fall; `dropped`, it starts as OGBench starts
    it, and may get up.
    """
    observation, goal = maze.reset(task_id, seed)
    goal_xy = float(goal[0]), float(goal[1])
    if not dropped:
        observation = maze.stand()
    rng = np.random.default_rng(seed)
    qpos = [maze.qpos]
    while True:
        target = maze.maze.waypoint(maze.maze.cell(*maze.position), goal_xy)
        offset = np.subtract(target, maze.position)
        action = follower.act(observation, offset / np.linalg.norm(offset), qpos[-1])
        result = maze.step(action + rng.normal(0.0, action_noise, action.shape))
        observation = result.observation
        qpos.append(maze.qpos)
        fallen = bool(has_fallen(qpos[-1])) and not dropped
        if result.terminated or result.truncated or fallen:
            falls = count_falls(np.array(qpos[: -1 if result.terminated else None]))
            duration_s = (len(qpos) - 1) * maze.spec.control_period_s
            return GoalRun(result.terminated, falls, duration_s)


def stands_up(follower: DirectionFollower, maze: OGBenchMaze, seed: int, within_s: float) -> bool:
    """Whether a humanoid stands a while after OGBench's start of a task, told to go nowhere."""
    observation, _ = maze.reset(seed % len(maze.tasks) + 1, seed)
    for _ in range(round(within_s / maze.spec.control_period_s)):
        action = follower.act(observation, np.zeros(2), maze.qpos)
        observation = maze.step(action).observation
    return bool(head_height(observation) > STANDING_HEAD_M)


def _stand_up(environment: Any, rng: np.random.Generator) -> None:
    x, y = environment.data.qpos[:2]
    qpos, _ = standing_pose((x, y), rng)
    environment.set_state(qpos, np.zeros(environment.model.nv))


def turned(direction: Array, angle_rad: float) -> Array:
    """The direction after a turn to the left."""
    x, y = direction
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([cos * x - sin * y, sin * x + cos * y])
