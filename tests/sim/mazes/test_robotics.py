"""gymnasium-robotics' mazes behind the interface: its own episodes, as vectors."""

from collections.abc import Iterator
import math
import os
from pathlib import Path
import tempfile
from typing import Any

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest
from sim_bridge import make_simulator, Simulator, SimulatorError
from sim_bridge.mazes.robotics_layouts import flip

pytestmark = [pytest.mark.mujoco, pytest.mark.filterwarnings('ignore:.*out of date')]
gymnasium.register_envs(gymnasium_robotics)
NAMES = ['PointMaze_Medium-v3', 'AntMaze_UMaze-v3', 'AntMaze_Large_Diverse_GR-v5']


@pytest.fixture(scope='module')
def built() -> Iterator[Simulator]:
    with make_simulator('PointMaze_UMaze-v3') as simulator:
        yield simulator


def theirs_of(name: str) -> Any:
    environment = gymnasium.make(name, disable_env_checker=True, continuing_task=False)
    os.unlink(environment.unwrapped.tmp_xml_file_path)
    return environment


def vector(name: str, observation: dict[str, np.ndarray]) -> np.ndarray:
    if name.startswith('Point'):
        return observation['observation']
    return np.concatenate([observation['achieved_goal'], observation['observation']])


@pytest.mark.parametrize('name', NAMES)
def test_reset_and_steps_equal_the_packages_bit_by_bit(name: str) -> None:
    theirs = theirs_of(name)
    layout = name.split('_', 1)[1].split('-')[0]
    with make_simulator(name) as ours:
        for task_id, seed in ((1, 0), (3, 123)):
            task = ours.tasks[task_id - 1]
            options = {
                'reset_cell': flip(layout, ours.maze.cell(*task.start_xy)),
                'goal_cell': flip(layout, ours.maze.cell(*task.goal_xy)),
            }
            expected, _ = theirs.reset(seed=seed, options=options)
            observation, goal = ours.reset(task_id=task_id, seed=seed)
            np.testing.assert_array_equal(observation, vector(name, expected))
            np.testing.assert_array_equal(goal[:2], expected['desired_goal'])
            np.testing.assert_array_equal(goal[2:], observation[2:])
            for action in np.random.default_rng(seed).uniform(-1, 1, (40, ours.spec.act_dim)):
                result = ours.step(action)
                raw, _, terminated, truncated, _ = theirs.step(action)
                np.testing.assert_array_equal(result.observation, vector(name, raw))
                assert (result.terminated, result.truncated) == (terminated, truncated)
                assert ours.position == tuple(result.observation[:2])


def test_starts_and_goals_lie_near_the_centers_of_the_tasks(built: Simulator) -> None:
    for task in built.tasks:
        for seed in range(10):
            observation, goal = built.reset(task_id=task.task_id, seed=seed)
            assert np.abs(observation[:2] - task.start_xy).max() <= 0.25
            assert np.abs(goal[:2] - task.goal_xy).max() <= 0.25


def test_goal_is_reached_within_its_tolerance_and_the_episode_ends(built: Simulator) -> None:
    built.reset(task_id=1, seed=0)
    goal = np.add(built.position, (0.5, 0.0))
    built.set_goal(goal)
    result = built.step((1.0, 0.0))
    while not result.terminated:
        assert math.dist(built.position, goal) > 0.45
        result = built.step((1.0, 0.0))
    assert result.success
    assert math.dist(built.position, goal) <= 0.45
    with pytest.raises(SimulatorError, match='the goal was reached at step'):
        built.step((0.0, 0.0))


def test_task_episode_is_truncated_at_the_packages_limit(built: Simulator) -> None:
    built.reset(task_id=1, seed=0)
    results = [built.step((0.0, 1.0)) for _ in range(300)]
    assert [result.truncated for result in results] == [False] * 299 + [True]


def test_same_seed_gives_the_same_episode_whatever_came_before(built: Simulator) -> None:
    def run() -> list[np.ndarray]:
        observations = [*built.reset(seed=11)]
        return observations + [built.step((0.3, 0.9)).observation for _ in range(20)]

    first = run()
    built.reset(task_id=4, seed=4)
    np.testing.assert_array_equal(first, run())
    assert not np.array_equal(first[0], built.reset(seed=12)[0])


def test_without_seeds_new_simulators_agree_and_episodes_differ() -> None:
    def starts() -> list[np.ndarray]:
        with make_simulator('PointMaze_UMaze-v3') as simulator:
            return [simulator.reset(task_id=1)[0] for _ in range(3)]

    first = starts()
    np.testing.assert_array_equal(first, starts())
    assert len({tuple(start) for start in first}) == 3


@pytest.mark.parametrize('name', NAMES)
def test_free_episode_starts_where_it_is_told_and_knows_no_goal(name: str) -> None:
    with make_simulator(name) as simulator:
        x, y = simulator.tasks[0].goal_xy
        start = (x + 0.125, y - 0.25)
        observation = simulator.reset_free(seed=1, start_xy=start)
        assert tuple(observation[:2]) == simulator.position == start
        assert observation.shape == (simulator.spec.obs_dim,)
        still = np.zeros(simulator.spec.act_dim)
        assert not simulator.step(still).success
        simulator.set_goal(simulator.position)
        result = simulator.step(still)
        assert result.success
        assert not result.terminated
        assert math.dist(simulator.position, start) < 0.3


def test_free_episode_draws_cells_and_refuses_walls(built: Simulator) -> None:
    cells = set()
    for seed in range(40):
        built.reset_free(seed=seed)
        cells.add(built.maze.cell(*built.position))
    assert cells == set(built.maze.free_cells())
    with pytest.raises(ValueError, match=r'start_xy \(0\.0, 0\.0\) is not in a free cell'):
        built.reset_free(start_xy=(0.0, 0.0))


@pytest.mark.parametrize('seed', [-1, 2**32])
def test_seed_out_of_range_is_refused(built: Simulator, seed: int) -> None:
    with pytest.raises(ValueError, match='seed must be from 0 to 4294967295'):
        built.reset(seed=seed)


def test_model_file_of_the_package_is_removed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    make_simulator('PointMaze_UMaze-v3').close()
    assert list(tmp_path.iterdir()) == []
