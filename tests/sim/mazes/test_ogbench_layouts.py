"""The tables of OGBench's mazes against the package's own environments."""

from typing import Any

import gymnasium
import numpy as np
import ogbench.locomaze  # registers the environments  # noqa: F401
import pytest
from sim_bridge import describe_environment
from sim_bridge.generation.behaviours import NOISE
from sim_bridge.mazes.ogbench import names

pytestmark = pytest.mark.mujoco


@pytest.fixture(scope='module', params=names())
def pair(request: pytest.FixtureRequest) -> tuple[Any, Any]:
    return describe_environment(request.param), gymnasium.make(request.param)


def test_spec_is_the_environments(pair: tuple[Any, Any]) -> None:
    spec, environment = pair[0].spec, pair[1]
    inner = environment.unwrapped
    assert spec.name == environment.spec.id
    assert environment.observation_space.shape == (spec.obs_dim,)
    assert environment.action_space.shape == (spec.act_dim,)
    assert (environment.action_space.low == -1).all()
    assert (environment.action_space.high == 1).all()
    assert spec.max_episode_steps == environment.spec.max_episode_steps
    assert spec.control_period_s == pytest.approx(inner.dt)
    assert spec.goal_tolerance_m == inner._goal_tol
    assert spec.num_tasks == inner.num_tasks
    assert NOISE == inner._noise / 4


def test_plan_is_the_environments(pair: tuple[Any, Any]) -> None:
    maze, inner = pair[0].maze, pair[1].unwrapped
    np.testing.assert_array_equal(maze.walls, inner.maze_map == 1)
    assert maze.unit_m == inner._maze_unit
    for i, j in np.ndindex(maze.walls.shape):
        assert maze.center(i, j) == inner.ij_to_xy((i, j))
    rng = np.random.default_rng(0)
    xmin, xmax, ymin, ymax = maze.extent
    for x, y in rng.uniform((xmin, ymin), (xmax, ymax), size=(200, 2)):
        assert maze.cell(x, y) == inner.xy_to_ij((x, y))


def test_tasks_are_the_environments(pair: tuple[Any, Any]) -> None:
    tasks, inner = pair[0].tasks, pair[1].unwrapped
    assert [task.task_id for task in tasks] == list(range(1, inner.num_tasks + 1))
    for task, info in zip(tasks, inner.task_infos, strict=True):
        assert task.name == info['task_name']
        assert task.start_xy == info['init_xy']
        assert task.goal_xy == info['goal_xy']


def test_maze_left_out_is_one_that_the_package_cannot_build() -> None:
    assert 'humanoidmaze-teleport-v0' not in names()
    with pytest.raises(ValueError, match="material 'teleport_in' not found"):
        gymnasium.make('humanoidmaze-teleport-v0')


@pytest.mark.parametrize('layout', ['medium', 'large', 'giant', 'teleport'])
def test_next_cell_is_the_environments_oracle_subgoal(layout: str) -> None:
    name = f'pointmaze-{layout}-v0'
    maze, inner = describe_environment(name).maze, gymnasium.make(name).unwrapped
    free = maze.free_cells()
    rng = np.random.default_rng(1)
    for start, goal in rng.integers(len(free), size=(150, 2)):
        ours = maze.next_cell(free[start], free[goal])
        theirs, _ = inner.get_oracle_subgoal(maze.center(*free[start]), maze.center(*free[goal]))
        assert maze.center(*ours) == tuple(theirs)
