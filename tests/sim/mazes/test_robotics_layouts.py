"""The tables of gymnasium-robotics' mazes against the package's own environments."""

from collections.abc import Iterator
import os
from typing import Any

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest
from sim_bridge import describe_environment
from sim_bridge.generation.behaviours import NOISE
from sim_bridge.mazes.robotics import names
from sim_bridge.mazes.robotics_layouts import flip

pytestmark = [pytest.mark.mujoco, pytest.mark.filterwarnings('ignore:.*out of date')]
gymnasium.register_envs(gymnasium_robotics)


@pytest.fixture(scope='module', params=names())
def pair(request: pytest.FixtureRequest) -> Iterator[tuple[Any, Any]]:
    environment = gymnasium.make(request.param, disable_env_checker=True, continuing_task=False)
    os.unlink(environment.unwrapped.tmp_xml_file_path)
    yield describe_environment(request.param), environment
    environment.close()


def test_spec_is_the_environments(pair: tuple[Any, Any]) -> None:
    spec, environment = pair[0].spec, pair[1]
    inner = environment.unwrapped
    robot = inner.point_env if spec.name.startswith('Point') else inner.ant_env
    assert spec.name == environment.spec.id
    assert robot.observation_space.shape == (spec.obs_dim,)
    assert environment.action_space.shape == (spec.act_dim,)
    assert (environment.action_space.low == -1).all()
    assert (environment.action_space.high == 1).all()
    assert spec.max_episode_steps == environment.spec.max_episode_steps
    assert spec.control_period_s == pytest.approx(robot.dt)
    reach = np.array([spec.goal_tolerance_m, 0.0])
    assert inner.compute_terminated(reach, np.zeros(2), {})
    assert not inner.compute_terminated(reach * 1.01, np.zeros(2), {})
    assert inner.position_noise_range == NOISE


def test_plan_is_the_environments(pair: tuple[Any, Any]) -> None:
    maze, inner = pair[0].maze, pair[1].unwrapped.maze
    layout = pair[0].spec.name.split('_', 1)[1].split('-')[0]
    assert maze.unit_m == inner.maze_size_scaling
    for i, j in np.ndindex(maze.walls.shape):
        theirs = flip(layout, (i, j))
        assert maze.walls[i, j] == (inner.maze_map[theirs[0]][theirs[1]] == 1)
        assert maze.center(i, j) == tuple(inner.cell_rowcol_to_xy(np.array(theirs)))


def test_tasks_are_its_own_starts_and_goals(pair: tuple[Any, Any]) -> None:
    description, inner = pair[0], pair[1].unwrapped.maze
    starts = {tuple(xy) for xy in inner.unique_reset_locations}
    goals = {tuple(xy) for xy in inner.unique_goal_locations}
    assert [task.task_id for task in description.tasks] == [
        *range(1, description.spec.num_tasks + 1)
    ]
    for task in description.tasks:
        assert task.start_xy in starts
        assert task.goal_xy in goals
        assert task.start_xy != task.goal_xy
    if 'Diverse' in description.spec.name:
        assert {task.goal_xy for task in description.tasks} == goals
