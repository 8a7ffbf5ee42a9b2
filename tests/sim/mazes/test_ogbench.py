"""OGBench's mazes behind the interface: its own protocol, exactly, and ours around it."""

import math
import os
from pathlib import Path
import tempfile
from typing import Any

import gymnasium
import numpy as np
import ogbench.locomaze  # registers the environments  # noqa: F401
import pytest
from sim_bridge import make_simulator, Simulator, SimulatorError
from sim_bridge.controllers.posture import has_fallen
from sim_bridge.mazes.ogbench import OGBenchMaze

pytestmark = pytest.mark.mujoco


def reset_ogbench(environment: Any, seed: int, **options: int) -> tuple[Any, Any]:
    """OGBench's reset, with every random source it reads seeded."""
    np.random.seed(seed)
    environment.action_space.seed(seed)
    observation, info = environment.reset(seed=seed, options=options)
    return observation, info['goal']


@pytest.mark.parametrize('robot', ['pointmaze', 'antmaze', 'humanoidmaze'])
def test_reset_and_steps_equal_ogbenchs_bit_by_bit(robot: str) -> None:
    name = f'{robot}-medium-v0'
    theirs = gymnasium.make(name)
    with make_simulator(name) as ours:
        for task_id, seed in ((1, 0), (4, 123)):
            expected = reset_ogbench(theirs, seed, task_id=task_id)
            observation, goal = ours.reset(task_id=task_id, seed=seed)
            np.testing.assert_array_equal(observation, expected[0])
            np.testing.assert_array_equal(goal, expected[1])
            for action in np.random.default_rng(seed).uniform(-1, 1, (40, ours.spec.act_dim)):
                result = ours.step(action)
                raw, _, terminated, truncated, info = theirs.step(action)
                np.testing.assert_array_equal(result.observation, raw)
                assert (result.terminated, result.truncated) == (terminated, truncated)
                assert result.success == bool(info['success'])
                np.testing.assert_array_equal(ours.qpos, info['qpos'])
                np.testing.assert_array_equal(ours.qvel, info['qvel'])


def test_task_is_drawn_as_ogbench_draws_it(built_point: Simulator) -> None:
    theirs = gymnasium.make('pointmaze-medium-v0')
    for seed in range(5):
        expected = reset_ogbench(theirs, seed)
        observation, goal = built_point.reset(seed=seed)
        np.testing.assert_array_equal(observation, expected[0])
        np.testing.assert_array_equal(goal, expected[1])


def test_whole_episode_ends_with_ogbenchs(built_point: Simulator) -> None:
    theirs = gymnasium.make('pointmaze-medium-v0')
    reset_ogbench(theirs, 3, task_id=1)
    built_point.reset(task_id=1, seed=3)
    for step in range(1, 1001):
        result = built_point.step((-1.0, -1.0))
        _, _, terminated, truncated, _ = theirs.step(np.array([-1.0, -1.0]))
        assert (result.terminated, result.truncated) == (terminated, truncated)
        assert result.truncated == (step == 1000)


def test_teleport_draws_the_exit_as_ogbench_does() -> None:
    theirs = gymnasium.make('pointmaze-teleport-v0')
    exits = set()
    with make_simulator('pointmaze-teleport-v0') as ours:
        for seed in range(8):
            reset_ogbench(theirs, seed, task_id=3)  # starts one cell away from an entry
            ours.reset(task_id=3, seed=seed)
            before = ours.position
            for _ in range(30):
                outside = np.random.get_state()[1].copy()  # type: ignore[index]
                ours.step((0.0, -1.0))
                np.testing.assert_array_equal(outside, np.random.get_state()[1])  # type: ignore[index]
                theirs.step(np.array([0.0, -1.0]))
                assert ours.position == tuple(theirs.unwrapped.get_xy())
                if math.dist(before, ours.position) > 2:
                    exits.add(ours.maze.cell(*ours.position))
                    break
                before = ours.position
    assert len(exits) > 1


def test_start_and_goal_lie_within_a_metre_of_the_tasks(built_point: Simulator) -> None:
    for task in built_point.tasks:
        for seed in range(20):
            observation, goal = built_point.reset(task_id=task.task_id, seed=seed)
            assert np.abs(observation - task.start_xy).max() <= 1.0
            assert np.abs(goal - task.goal_xy).max() <= 1.0
            assert built_point.position == tuple(observation)


def test_same_seed_gives_the_same_episode_whatever_came_before(built_point: Simulator) -> None:
    def run() -> list[np.ndarray]:
        observations = [*built_point.reset(task_id=2, seed=11)]
        return observations + [built_point.step((0.3, 0.9)).observation for _ in range(20)]

    first = run()
    built_point.reset(task_id=5, seed=4)
    built_point.step((1.0, 0.0))
    np.random.seed(99)
    np.testing.assert_array_equal(first, run())
    assert not np.array_equal(first[0], built_point.reset(task_id=2, seed=12)[0])


def test_without_seeds_new_simulators_agree_and_episodes_differ() -> None:
    def starts() -> list[np.ndarray]:
        with make_simulator('pointmaze-medium-v0') as simulator:
            return [simulator.reset(task_id=1)[0] for _ in range(3)]

    first = starts()
    np.testing.assert_array_equal(first, starts())
    assert len({tuple(start) for start in first}) == 3


def test_global_generator_of_numpy_is_left_alone(built_point: Simulator) -> None:
    np.random.seed(5)
    np.random.standard_normal()  # leaves a second normal number waiting
    expected = np.random.RandomState(5).standard_normal(3)[1:]
    built_point.reset(seed=1)
    built_point.reset_free()
    built_point.step((0.0, 0.0))
    np.testing.assert_array_equal(np.random.standard_normal(2), expected)


@pytest.mark.parametrize(
    ('distance', 'success'), [(1.0, True), (math.nextafter(1.0, 2.0), False), (0.0, True)]
)
def test_success_is_within_the_tolerance_edge_included(
    point: Simulator, distance: float, success: bool
) -> None:
    point.set_goal((distance, 0.0))
    result = point.step((0.0, 0.0))
    assert point.position == (0.0, 0.0)
    assert result.success is success


def test_success_ends_a_task_but_not_a_free_episode(point: Simulator) -> None:
    point.set_goal((0.5, 0.0))
    result = point.step((0.0, 0.0))
    assert (result.success, result.terminated, result.truncated) == (True, False, False)
    point.reset(task_id=1, seed=0)
    point.set_goal(point.position)
    result = point.step((0.0, 0.0))
    assert (result.success, result.terminated, result.truncated) == (True, True, False)
    with pytest.raises(SimulatorError, match='the goal was reached at step 1'):
        point.step((0.0, 0.0))


def test_free_episode_outlives_the_step_limit_and_has_no_goal(point: Simulator) -> None:
    for _ in range(point.spec.max_episode_steps + 5):
        result = point.step((0.0, 0.0))
        assert not (result.terminated or result.truncated or result.success)


def test_task_episode_refuses_to_go_on_after_the_limit(built_point: Simulator) -> None:
    built_point.reset(task_id=1, seed=0)
    for _ in range(1000):
        result = built_point.step((0.0, 0.0))
    assert result.truncated
    with pytest.raises(SimulatorError, match='the step limit was reached at step 1000'):
        built_point.step((0.0, 0.0))


def test_free_start_is_where_it_was_asked_for_or_drawn_in_a_free_cell(point: Simulator) -> None:
    assert point.reset_free(start_xy=(4.5, 3.25)).tolist() == [4.5, 3.25]
    starts = [point.reset_free(seed=seed) for seed in range(40)]
    assert all(point.maze.is_free(*start) for start in starts)
    assert len({point.maze.cell(*start) for start in starts}) > 10
    np.testing.assert_array_equal(starts[7], point.reset_free(seed=7))


def test_free_start_keeps_the_pose_of_a_walking_robot() -> None:
    with make_simulator('antmaze-medium-v0') as ant:
        placed = ant.reset_free(seed=2, start_xy=(8.0, 8.0))
        assert placed[:2].tolist() == [8.0, 8.0]
        assert placed[2] == pytest.approx(0.75, abs=0.1)  # torso height
        assert ant.position == (8.0, 8.0)
        np.testing.assert_array_equal(placed, np.concatenate([ant.qpos, ant.qvel]))


def test_humanoid_starts_free_episodes_as_its_tasks() -> None:
    with make_simulator('humanoidmaze-medium-v0', standing=True) as humanoid:
        placed = humanoid.reset_free(seed=2, start_xy=(8.0, 8.0))
        assert placed[:2].tolist() == [8.0, 8.0]
        assert placed[23] == pytest.approx(1.49)  # height of the head
        assert not humanoid.qvel.any()
        np.testing.assert_array_equal(placed, humanoid.reset_free(seed=2, start_xy=(8.0, 8.0)))
        yaws = [humanoid.reset_free(seed=seed, start_xy=(8.0, 8.0)) for seed in range(2)]
        assert not np.array_equal(*yaws)
    with make_simulator('humanoidmaze-medium-v0') as humanoid:
        dropped = humanoid.reset_free(seed=2, start_xy=(8.0, 8.0))
        assert dropped[:2].tolist() == [8.0, 8.0]
        assert dropped[36:39].tolist() != pytest.approx([0, 0, 1], abs=0.01)
        for _ in range(60):
            humanoid.step(np.zeros(21))
        assert has_fallen(humanoid.qpos)
        before = humanoid.reset(task_id=1, seed=0)[0]
        assert isinstance(humanoid, OGBenchMaze)
        after = humanoid.stand()
        assert after[23] == pytest.approx(1.49)
        assert after[:2].tolist() == before[:2].tolist()
        assert before[36:39].tolist() != pytest.approx([0, 0, 1], abs=0.01)


def test_humanoid_that_starts_standing_has_ogbenchs_places() -> None:
    with (
        make_simulator('humanoidmaze-medium-v0') as fallen,
        make_simulator('humanoidmaze-medium-v0', standing=True) as standing,
    ):
        for seed in (3, 4):
            theirs, ours = (maze.reset(task_id=2, seed=seed) for maze in (fallen, standing))
            for lying, upright in zip(theirs, ours, strict=True):
                assert upright[:2].tolist() == lying[:2].tolist()
                assert upright[23] == pytest.approx(1.49)
                np.testing.assert_allclose(upright[36:39], [0, 0, 1], atol=1e-9)
                assert not upright[39:].any()  # at rest
            assert (theirs[0][2:23] != ours[0][2:23]).all()
        np.testing.assert_array_equal(standing.reset(task_id=2, seed=4), ours)
        assert standing.position == tuple(ours[0][:2])
        assert not standing.step(np.zeros(21)).success
        standing.environment.set_xy(ours[1][:2])
        assert standing.step(np.zeros(21)).success


def test_only_humanoids_have_a_standing_start() -> None:
    for name in ('antmaze-medium-v0', 'PointMaze_UMaze-v3'):
        with pytest.raises(ValueError, match=f'{name}: only humanoids have a standing start'):
            make_simulator(name, standing=True)


def test_standing_robots_are_left_as_they_are() -> None:
    with OGBenchMaze('antmaze-medium-v0') as ant:
        observation, _ = ant.reset(task_id=1, seed=0)
        np.testing.assert_array_equal(ant.stand(), observation)


def test_goal_can_be_an_observation() -> None:
    with make_simulator('antmaze-medium-v0') as ant:
        observation, goal = ant.reset(task_id=1, seed=0)
        ant.set_goal(observation)
        assert ant.step(np.zeros(8)).success
        assert goal.shape == (29,)


def test_action_beyond_the_bounds_is_clipped(point: Simulator) -> None:
    cut = point.step((5.0, 0.25))
    point.reset_free(seed=0, start_xy=(0.0, 0.0))
    np.testing.assert_array_equal(cut.observation, point.step((1.0, 0.25)).observation)


def test_results_do_not_change_afterwards(point: Simulator) -> None:
    first = point.step((1.0, 0.0)).observation
    kept, qpos = first.copy(), point.qpos
    point.step((1.0, 0.0))
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(qpos, kept)


@pytest.mark.parametrize(
    ('action', 'message'),
    [
        ((1.0,), r'action must have shape \(2,\), got \(1,\)'),
        (((1.0, 0.0),), r'got \(1, 2\)'),
        ((math.nan, 0.0), r'action must be finite, got \[nan, 0.0\]'),
        ((0.0, math.inf), 'action must be finite'),
    ],
)
def test_bad_action_is_refused_and_moves_nothing(
    point: Simulator, action: Any, message: str
) -> None:
    before = point.qpos
    with pytest.raises(ValueError, match=message):
        point.step(action)
    np.testing.assert_array_equal(point.qpos, before)


@pytest.mark.parametrize('task_id', [0, 6, -1, True, 1.0, '1'])
def test_bad_task_is_refused(built_point: Simulator, task_id: Any) -> None:
    with pytest.raises(ValueError, match='task_id must be from 1 to 5, got'):
        built_point.reset(task_id=task_id)


def test_bad_seed_is_refused(built_point: Simulator) -> None:
    with pytest.raises(ValueError, match='seed must be from 0 to 4294967295, got -1'):
        built_point.reset(seed=-1)
    with pytest.raises(ValueError, match='seed must be from 0'):
        built_point.reset_free(seed=2**32)


@pytest.mark.parametrize('start', [(8.0, 0.0), (100.0, 0.0), (math.nan, 0.0)])
def test_start_in_a_wall_or_outside_is_refused(
    built_point: Simulator, start: tuple[float, float]
) -> None:
    with pytest.raises(ValueError, match='is not in a free cell'):
        built_point.reset_free(start_xy=start)


@pytest.mark.parametrize(
    ('goal', 'message'),
    [
        ((1.0, 2.0, 3.0), r'goal must have shape \(2,\)'),
        ((math.nan, 0.0), 'goal must be finite'),
        ((-7.0, 0.0), 'lies outside the maze'),
    ],
)
def test_bad_goal_is_refused(point: Simulator, goal: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        point.set_goal(goal)


def test_simulator_must_be_reset_first_and_not_used_after_close() -> None:
    simulator = make_simulator('pointmaze-medium-v0')
    with pytest.raises(SimulatorError, match='it was never reset'):
        simulator.step((0.0, 0.0))
    with pytest.raises(SimulatorError, match='it was never reset'):
        simulator.set_goal((0.0, 0.0))
    simulator.reset(task_id=1)
    simulator.close()
    with pytest.raises(SimulatorError, match='the simulator is closed'):
        simulator.step((0.0, 0.0))


def test_building_leaves_no_file_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    make_simulator('pointmaze-medium-v0').close()
    assert os.listdir(tmp_path) == []
