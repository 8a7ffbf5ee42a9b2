"""Training environment of the humanoid: many at once, on a floor or in mazes."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from sim_bridge.controllers.humanoid import (
    com_velocity,
    head_height,
    policy_inputs,
)
from sim_bridge.controllers.humanoid_crowd import (
    observe,
    physics_states,
    set_physics_states,
)
from sim_bridge.controllers.humanoid_reward import walking_reward
from sim_bridge.controllers.posture import FALLEN_HEAD_M
from sim_bridge.maze_map import Cell, MazeMap
from sim_bridge.mazes.ogbench import (
    describe,
    make_environment,
    open_floor,
    standing_pose,
)
from sim_bridge.simulator import Array

FRAME_SKIP = 5
PERIOD_S = 0.025
EPISODE_STEPS = 1000
GOAL_TOLERANCE_M = 0.5
PLACE_NOISE_M = 1.0

_SWITCH_STEPS = (50, 200)
_FACING = 64  # place of the direction's part along the torso's x axis among the policy's inputs


@dataclass(frozen=True, slots=True)
class Course:
    """The conditions of training in one stage.

    Attributes:
        floors: Humanoids on an open floor.
        mazes: Layouts of the humanoids in mazes, one each, such as `medium`.
        turn_rad: A new direction is the heading (at the start) or the old direction plus at most
            this angle; at the beginning and after `turn_steps`.
        turn_steps: Control steps per humanoid over which the angle grows linearly.
        p_turning: Share of the episodes on the floor whose direction changes on the way.
        noisy: Share of the humanoids whose actions are disturbed.
        action_noise: Standard deviation of what is added to their actions.
        p_push: Probability of a push per control step.
        push_m_s: A push adds at most this velocity along x and along y.
    """

    floors: int
    mazes: tuple[str, ...] = ()
    turn_rad: tuple[float, float] = (math.pi, math.pi)
    turn_steps: int = 1
    p_turning: float = 0.6
    noisy: float = 0.0
    action_noise: float = 0.2
    p_push: float = 0.0
    push_m_s: float = 0.5

    def ground(self, rng: np.random.Generator) -> 'HumanoidGround':
        """The humanoids, on their feet."""
        return HumanoidGround(self, rng)


@dataclass(frozen=True, slots=True)
class GroundStep:
    """The outcome of one control step of n humanoids.

    Attributes:
        next_inputs: What the policy would see next were its direction kept, shape (n, 67).
        rewards: Shape (n,).
        fallen: The episode is over by a fall.
        cut: The next step belongs to another episode or direction, shape (n,).
        figures: Means to log, by name.
    """

    next_inputs: Array
    rewards: Array
    fallen: NDArray[np.bool_]
    cut: NDArray[np.bool_]
    figures: dict[str, float]


class HumanoidGround:
    """n humanoids, each with a direction to follow; those that fall stand up again at once.

    Attributes:
        inputs: What the policy sees now, shape (n, 67).
    """

    def __init__(self, course: Course, rng: np.random.Generator) -> None:
        """Load the physics and stand everyone up."""
        self.course = course
        mazes = [f'humanoidmaze-{layout}-v0' for layout in course.mazes]
        self._envs = [open_floor('humanoid') for _ in range(course.floors)]
        self._envs += [make_environment(name) for name in mazes]
        self.count = len(self._envs)
        self._maps: list[MazeMap | None] = [None] * course.floors
        self._maps += [describe(name).maze for name in mazes]
        noisy = np.arange(self.count) * course.noisy % 1 + course.noisy >= 1  # spread evenly
        self._noise = course.action_noise * noisy[:, None]
        self._angles = np.zeros(self.count)
        self._steps = np.zeros(self.count, np.int64)
        self._switch_at = np.zeros(self.count, np.int64)
        self._cells = np.zeros((self.count, 2), np.int64)
        self._goals = np.zeros((self.count, 2))
        self._steps_done = 0
        for index in range(self.count):
            self._restart(index, rng)
        self.inputs = self._look()

    def step(self, actions: Array, rng: np.random.Generator) -> GroundStep:
        """Apply actions of shape (n, 21), each number within -1 to 1."""
        directions = self._directions()
        disturbed = actions + self._noise * rng.standard_normal(actions.shape)
        pushed = rng.random(self.count) < self.course.p_push
        pushes = rng.uniform(-1, 1, (self.count, 2)) * self.course.push_m_s
        for env, action, push in zip(
            self._envs, disturbed.clip(-1, 1), pushes * pushed[:, None], strict=True
        ):
            env.data.qvel[:2] += push
            env.do_simulation(action, FRAME_SKIP)
        self._steps += 1
        self._steps_done += 1
        for index in range(self.course.floors, self.count):
            self._aim(index)  # at the same point, from where the humanoid is now
        observations, quaternions = observe(self._envs)
        next_inputs = policy_inputs(observations, quaternions, self._directions())
        rewards = walking_reward(observations, next_inputs[:, _FACING], directions, actions)
        speeds = (com_velocity(observations) * directions).sum(axis=-1)
        fallen = head_height(observations) < FALLEN_HEAD_M
        over = fallen | (self._steps >= EPISODE_STEPS)
        cut = over.copy()
        for index in range(self.count):
            if over[index]:
                self._restart(index, rng)
            else:
                cut[index] = self._redirect(index, rng)
        self.inputs = self._look() if cut.any() else next_inputs
        figures = {'speed_m_s': speeds.mean(), 'falls_per_1000_steps': 1000 * fallen.mean()}
        return GroundStep(next_inputs, rewards, fallen, cut, figures)

    def turn(self, angles: Array) -> None:
        """Change the directions of the humanoids on the floor by these angles, radians."""
        self._angles += angles
        self.inputs = self._look()

    def arrays(self) -> dict[str, np.ndarray]:
        """State of the training for a resumed run, by name."""
        return {
            'physics': physics_states(self._envs),
            'angles': self._angles,
            'steps': self._steps,
            'switch_at': self._switch_at,
            'cells': self._cells,
            'goals': self._goals,
            'steps_done': np.array(self._steps_done),
        }

    def load_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what `arrays` gave."""
        set_physics_states(self._envs, arrays['physics'])
        for name in ('angles', 'steps', 'switch_at', 'cells', 'goals'):
            getattr(self, f'_{name}')[...] = arrays[name]
        self._steps_done = int(arrays['steps_done'])
        self.inputs = self._look()

    def _look(self) -> Array:
        return policy_inputs(*observe(self._envs), self._directions())

    def _directions(self) -> Array:
        return np.stack([np.cos(self._angles), np.sin(self._angles)], axis=-1)

    def _turn(self, rng: np.random.Generator) -> float:
        """Draw how far a new direction lies from the old one, radians."""
        first, last = self.course.turn_rad
        grown = min(1.0, self._steps_done / self.course.turn_steps)
        widest = first + grown * (last - first)
        return float(rng.uniform(-widest, widest))

    def _restart(self, index: int, rng: np.random.Generator) -> None:
        env, maze = self._envs[index], self._maps[index]
        xy = (0.0, 0.0) if maze is None else near(maze, _draw(maze, rng), rng)
        qpos, yaw = standing_pose(xy, rng)
        env.set_state(qpos, np.zeros(env.model.nv))
        self._steps[index] = 0
        if maze is not None:
            self._cells[index] = maze.cell(*xy)
            self._new_goal(index, maze, rng)
            return
        self._angles[index] = yaw + self._turn(rng)
        turning = rng.random() < self.course.p_turning
        self._switch_at[index] = rng.integers(*_SWITCH_STEPS) if turning else EPISODE_STEPS

    def _redirect(self, index: int, rng: np.random.Generator) -> bool:
        """Give a new direction if one is due; returns whether one was."""
        maze = self._maps[index]
        if maze is None:
            due = self._steps[index] >= self._switch_at[index]
            if due:
                self._angles[index] += self._turn(rng)
                self._switch_at[index] += rng.integers(*_SWITCH_STEPS)
            return bool(due)
        xy = self._envs[index].data.qpos[:2]
        if math.dist(xy, self._goals[index]) <= GOAL_TOLERANCE_M:
            self._new_goal(index, maze, rng)
            return True
        cell = maze.cell(*xy)
        if cell == tuple(self._cells[index]) or maze.walls[cell]:
            return False
        self._cells[index] = cell
        self._aim(index)
        return True

    def _new_goal(self, index: int, maze: MazeMap, rng: np.random.Generator) -> None:
        self._goals[index] = near(maze, _draw(maze, rng), rng)
        self._aim(index)

    def _aim(self, index: int) -> None:
        """Point along the shortest way to the goal, through the centres of cells."""
        maze = self._maps[index]
        assert maze is not None
        row, column = self._cells[index].tolist()
        aim = maze.waypoint((row, column), tuple(self._goals[index]))
        x, y = self._envs[index].data.qpos[:2]
        self._angles[index] = math.atan2(aim[1] - y, aim[0] - x)


def near(maze: MazeMap, cell: Cell, rng: np.random.Generator) -> tuple[float, float]:
    """Draw a point within a metre of the centre of a cell, in x and in y."""
    x, y = maze.center(*cell)
    dx, dy = rng.uniform(-PLACE_NOISE_M, PLACE_NOISE_M, size=2)
    return x + dx, y + dy


def _draw(maze: MazeMap, rng: np.random.Generator) -> Cell:
    cells = maze.free_cells()
    return cells[rng.integers(len(cells))]
