"""Values by place: means of cells, false peaks, and how they rank with the way to the goal."""

import json

from metagcttt_core import save_checkpoint, TrajectoryDataset
from metagcttt_tools import draw_values
from metagcttt_tools.draw_values import cell_values, false_peaks, rank_correlation
import numpy as np
import pytest
from sim_bridge.maze_map import MazeMap
from tests.core.builders import maze_walks, tiny_agent
from tests.tools.tables import squeezed

# The first row is the lowest: a way of five cells around a wall.
MAZE = MazeMap.from_rows(['...', '.#.'], unit_m=2.0, origin_xy=(0.0, 0.0))
GOAL = (1, 0)
TRUE = np.array([[-1.0, -2.0, -3.0], [0.0, np.nan, -4.0]])


def test_a_cell_has_the_mean_of_its_states():
    points = np.array([MAZE.center(0, 0), MAZE.center(0, 0), MAZE.center(1, 2)])
    found = cell_values(MAZE, MAZE.cells(points), np.array([-1.0, -2.0, -5.0]))
    np.testing.assert_array_equal(found[0], [-1.5, np.nan, np.nan])
    assert found[1, 2] == -5.0


def test_values_that_fall_along_the_way_have_no_false_peak():
    assert false_peaks(MAZE, TRUE, GOAL) == []
    assert rank_correlation(MAZE, TRUE, GOAL) == pytest.approx(1.0)


def test_a_dead_end_near_the_goal_through_a_wall_is_a_false_peak():
    mistaken = TRUE.copy()
    mistaken[1, 2] = -1.5  # two cells from the goal as the crow flies
    assert false_peaks(MAZE, mistaken, GOAL) == [(1, 2)]
    # Nearness -4 to 0 ranks 1 to 5, values rank 3, 1, 2, 4, 5: 1 - 6 (4 + 1 + 1) / (5 * 24).
    assert rank_correlation(MAZE, mistaken, GOAL) == pytest.approx(0.7)


def test_cells_without_states_are_left_out():
    partly = TRUE.copy()
    partly[0, 1] = np.nan
    assert false_peaks(MAZE, partly, GOAL) == [(0, 2)]
    assert rank_correlation(MAZE, partly, GOAL) == pytest.approx(1.0)


@pytest.fixture
def arguments(tmp_path):
    def made(kind, *, farthest_m=25.0):
        agent = tiny_agent(kind)
        agent.metadata = {'environment': 'pointmaze-medium-v0'}
        save_checkpoint(agent, tmp_path / kind)
        walks = maze_walks()
        TrajectoryDataset.from_arrays(
            walks.observations.clip(-5, farthest_m), walks.actions, walks.terminals
        ).save(tmp_path / 'walks.npz')
        given = ['--checkpoint', str(tmp_path / kind), '--dataset', str(tmp_path / 'walks.npz')]
        return [*given, '--out', str(tmp_path / 'values')]

    return made


@pytest.mark.mujoco
def test_every_task_has_a_panel_and_a_row(arguments, tmp_path, capsys):
    draw_values.main(arguments('gciql'))
    printed = squeezed(capsys.readouterr().out)
    tasks = json.loads((tmp_path / 'values.json').read_text())['results']['tasks']
    assert [task['task'] for task in tasks] == [1, 2, 3, 4, 5]
    assert all(-1 <= task['rank_correlation'] <= 1 for task in tasks)
    assert all(f'| {task["task"]} | {task["rank_correlation"]:.2f} |' in printed for task in tasks)
    assert (tmp_path / 'values.png').read_bytes().startswith(b'\x89PNG')


def test_a_policy_without_a_critic_is_refused(arguments, capsys):
    with pytest.raises(SystemExit, match='2'):
        draw_values.main(arguments('gcbc'))
    assert 'gcbc has no critic, so no values' in capsys.readouterr().err


@pytest.mark.mujoco
def test_data_of_another_maze_are_refused(arguments, capsys):
    with pytest.raises(SystemExit, match='2'):
        draw_values.main(arguments('gciql', farthest_m=30.0))
    assert 'walks.npz is not of pointmaze-medium-v0: point (' in capsys.readouterr().err
