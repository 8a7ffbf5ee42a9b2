"""Recorded episodes: what the behaviour policy does and what is stored of it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from sim_bridge import maze_map, Simulator
from sim_bridge.controllers import PointFollower
from sim_bridge.generation.behaviours import BEHAVIOURS, Kind, Stitch
from sim_bridge.generation.episodes import Episode, episode_generator, record_episode
from sim_bridge.maze_map import Cell, MazeMap
from sim_bridge.simulator import StepResult

pytestmark = pytest.mark.mujoco
KINDS: list[Kind] = ['navigate', 'stitch', 'explore']


def record(
    simulator: Simulator, kind: Kind, num_rows: int, noise: float = 0.5, index: int = 0
) -> Episode:
    rng = episode_generator(0, validation=False, index=index)
    return record_episode(simulator, PointFollower(), kind, num_rows, noise, rng)


def cells_of(maze: MazeMap, episode: Episode) -> list[Cell]:
    return [maze.cell(*position) for position in episode.observations.tolist()]


@pytest.mark.parametrize('kind', KINDS)
def test_episode_has_the_asked_rows_in_ogbenchs_types(built_point: Simulator, kind: Kind) -> None:
    episode = record(built_point, kind, 40)
    for name in ('observations', 'actions', 'qpos', 'qvel'):
        array = getattr(episode, name)
        assert array.shape == (40, 2)
        assert array.dtype == np.float32
    assert np.abs(episode.actions).max() <= 1
    np.testing.assert_array_equal(episode.observations, episode.qpos)


@pytest.mark.parametrize('kind', KINDS)
def test_actions_lead_from_each_row_to_the_next(built_point: Simulator, kind: Kind) -> None:
    episode = record(built_point, kind, 150)
    built_point.reset_free(start_xy=tuple(episode.observations[0].tolist()))
    for row in range(149):
        observation = built_point.step(episode.actions[row]).observation
        np.testing.assert_allclose(observation, episode.observations[row + 1], atol=1e-3)


def test_generators_differ_by_seed_episode_and_split_and_by_nothing_else() -> None:
    def first(seed: int, validation: bool, index: int) -> int:
        return int(episode_generator(seed, validation, index).integers(2**62))

    keys = [(seed, split, index) for seed in (0, 1) for split in (False, True) for index in (0, 1)]
    assert len({first(*key) for key in keys}) == len(keys)
    assert [first(*key) for key in keys] == [first(*key) for key in keys]


def test_navigate_reaches_one_goal_after_another(built_point: Simulator) -> None:
    assert record(built_point, 'navigate', 1001).goals_reached >= 4
    assert record(built_point, 'navigate', 2).goals_reached <= 1


@pytest.mark.parametrize('to_goal', [False, True])
def test_on_arrival_the_way_is_to_the_center_or_to_the_goal(
    built_point: Simulator, to_goal: bool
) -> None:
    behaviour = BEHAVIOURS['navigate'](built_point.maze, episode_generator(0, False, 0), to_goal)
    center = built_point.maze.center(*behaviour._goal_cell)  # type: ignore[attr-defined]
    behaviour.near_center = lambda cell: (center[0] + 1.0, center[1] - 1.0)  # type: ignore[method-assign]
    built_point.reset_free(seed=0, start_xy=(center[0], center[1] - 1.0))
    behaviour.begin(built_point)
    expected = (1.0, 0.0) if to_goal else (0.0, 1.0)
    np.testing.assert_allclose(behaviour.direction(built_point, 0), expected, atol=1e-4)
    elsewhere = next(
        cell
        for cell in built_point.maze.free_cells()
        if cell != behaviour._goal_cell  # type: ignore[attr-defined]
    )
    built_point.reset_free(seed=0, start_xy=built_point.maze.center(*elsewhere))
    ahead = built_point.maze.next_cell(elsewhere, behaviour._goal_cell)  # type: ignore[attr-defined]
    way = np.subtract(built_point.maze.center(*ahead), built_point.maze.center(*elsewhere))
    np.testing.assert_allclose(behaviour.direction(built_point, 0), way / 4.0, atol=1e-4)


def test_navigate_draws_goals_outside_corridors_only() -> None:
    maze = maze_map('pointmaze-medium-v0')
    drawn = set()
    for index in range(300):
        behaviour = BEHAVIOURS['navigate'](maze, episode_generator(0, False, index))
        assert maze.is_free(*behaviour.start_xy)
        drawn.add(behaviour._goal_cell)  # type: ignore[attr-defined]
    assert drawn == set(maze.open_cells())


def test_stitch_goes_to_a_cell_four_away_and_stays(built_point: Simulator) -> None:
    maze = built_point.maze
    for index in range(5):
        episode = record(built_point, 'stitch', 201, noise=0.1, index=index)
        cells = cells_of(maze, episode)
        assert maze.distances(cells[0])[cells[-1]] == 4
        assert cells[-50:] == [cells[-1]] * 50
        assert episode.goals_reached == 1


def test_stitch_stays_where_no_cell_is_four_away() -> None:
    maze = MazeMap.from_rows(('####', '#..#', '####'), unit_m=4.0, origin_xy=(-4.0, -4.0))
    behaviour = Stitch(maze, episode_generator(0, False, 0))
    assert behaviour._goal_cell == behaviour.start_cell


def test_explore_keeps_a_direction_for_ten_steps(built_point: Simulator) -> None:
    episode = record(built_point, 'explore', 40, noise=0.0)
    blocks = episode.actions.reshape(4, 10, 2)
    assert (blocks == blocks[:, :1]).all()
    assert len(np.unique(blocks[:, 0], axis=0)) == 4
    np.testing.assert_allclose(np.linalg.norm(blocks[:, 0], axis=1), 1.0, atol=1e-5)
    assert episode.goals_reached == 0


def test_noise_has_the_asked_deviation(built_point: Simulator) -> None:
    calm = record(built_point, 'explore', 500, noise=0.0)
    noisy = record(built_point, 'explore', 500, noise=0.05)
    # Directions are drawn between the noise, so compare within a block of one direction.
    assert np.ptp(calm.actions.reshape(50, 10, 2), axis=1).max() == 0
    inner = np.abs(noisy.actions.reshape(50, 10, 2)).max(axis=(1, 2)) < 0.99  # nothing was cut
    spread = noisy.actions.reshape(50, 10, 2)[inner].std(axis=1, ddof=1)
    assert np.sqrt((spread**2).mean()) == pytest.approx(0.05, rel=0.1)


class Spills:
    """A point whose episodes "fall" after so many steps each; a second is four of its rows."""

    def __init__(self, simulator: Simulator, steps: Sequence[int]) -> None:
        self._simulator = simulator
        self._steps = iter(steps)
        self.spec = replace(simulator.spec, control_period_s=0.25)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._simulator, name)

    def reset_free(self, **options: Any) -> np.ndarray:
        self._left = next(self._steps)
        return self._simulator.reset_free(**options)

    def step(self, action: np.ndarray) -> StepResult:
        self._left -= 1
        return self._simulator.step(action)

    @property
    def qpos(self) -> np.ndarray:
        qpos = np.zeros(28)
        qpos[:2], qpos[2] = self._simulator.position, 0.5 if self._left <= 0 else 1.3
        return qpos


@pytest.mark.parametrize(('steps', 'rows'), [([10], 6), ([6], 2), ([5, 3, 9], 5), ([30], 20)])
def test_episode_is_cut_a_second_before_a_fall(
    built_point: Simulator, steps: list[int], rows: int
) -> None:
    spill = cast(Simulator, Spills(built_point, steps))
    rng = episode_generator(0, validation=False, index=0)
    episode = record_episode(
        spill, PointFollower(), 'navigate', 20, 0.5, rng, to_goal=False, cut_falls=True
    )
    assert [len(episode.actions), len(episode.qpos), len(episode.qvel)] == 3 * [rows]
    assert episode.terminals.tolist() == [*(rows - 1) * [False], True]
    if len(steps) == 1:
        whole = record(built_point, 'navigate', 20)
        np.testing.assert_array_equal(episode.observations, whole.observations[:rows])


def test_falls_do_not_end_an_episode_unless_asked(built_point: Simulator) -> None:
    spill = cast(Simulator, Spills(built_point, [1]))
    rng = episode_generator(0, validation=False, index=0)
    episode = record_episode(spill, PointFollower(), 'navigate', 20, 0.5, rng)
    np.testing.assert_array_equal(
        episode.observations, record(built_point, 'navigate', 20).observations
    )
