"""The action fields: the expert is made again from what the graph reports."""

from dataclasses import replace

from metagcttt_core import (
    adapt,
    Agent,
    make_agent,
    TrajectoryDataset,
    TrajectoryFilter,
    TTTConfig,
)
from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_tools.live.fields import Deployed, expert_of, grid_of, Query
from metagcttt_tools.live.scene import floor_point, viewpoint
import numpy as np
import pytest
from sim_bridge import maze_map
from tests.ros.live.browser import drawn_at
from tests.ros.maze_walks import maze_walks

MAZE = maze_map('pointmaze-medium-v0')
GOAL = np.array([20.0, 20.0])
CONFIG = TTTConfig(steps=5, batch_size=32)


@pytest.fixture(scope='module')
def deployed() -> Deployed:
    dataset: TrajectoryDataset = maze_walks('pointmaze-medium-v0')
    return Deployed(make_agent('gcbc', obs_dim=2, act_dim=2, hidden=(16, 16)), dataset)


@pytest.fixture(scope='module')
def adapted(deployed: Deployed) -> tuple[Agent, Query]:
    """An expert as the policy node makes it, and what is reported of it."""
    support = TrajectoryFilter(deployed.dataset).query(deployed.dataset.observations[0], GOAL)
    made = adapt(deployed.agent, deployed.dataset, support, GOAL, CONFIG, seed=7)
    return made.agent, Query(GOAL, 7, support.segments, made.train_losses)


def never() -> bool:
    return False


def test_expert_is_the_one_that_acts(deployed: Deployed, adapted: tuple[Agent, Query]) -> None:
    expert, query = adapted
    points = grid_of(MAZE)
    again = expert_of(deployed, query, CONFIG, never)
    np.testing.assert_array_equal(again.act(points, GOAL), expert.act(points, GOAL))
    assert not np.allclose(again.act(points, GOAL), deployed.agent.act(points, GOAL))


@pytest.mark.parametrize(
    'change', [{'lr': 3e-2}, {'steps': 4}, {'batch_size': 31}], ids=['lr', 'K', 'batch']
)
def test_other_settings_than_reported_are_noticed(
    change: dict, deployed: Deployed, adapted: tuple[Agent, Query]
) -> None:
    config = CONFIG.model_copy(update=change)
    with pytest.raises(ValueError, match='the losses differ'):
        expert_of(deployed, adapted[1], config, never)


def test_other_seed_than_reported_is_noticed(
    deployed: Deployed, adapted: tuple[Agent, Query]
) -> None:
    with pytest.raises(ValueError, match='the losses differ'):
        expert_of(deployed, replace(adapted[1], seed=8), CONFIG, never)


def test_superseded_work_ends(deployed: Deployed, adapted: tuple[Agent, Query]) -> None:
    with pytest.raises(AdaptationCancelled):
        expert_of(deployed, adapted[1], CONFIG, lambda: True)


def test_field_is_spread_over_the_free_cells() -> None:
    cells = [MAZE.cell(*point) for point in grid_of(MAZE)]
    assert len(cells) == 9 * np.count_nonzero(~MAZE.walls)
    assert {cell: cells.count(cell) for cell in cells} == {
        (int(row), int(col)): 9 for row, col in np.argwhere(~MAZE.walls)
    }


def test_ray_meets_the_floor_where_it_was_aimed() -> None:
    camera = np.array(viewpoint(MAZE)[0])
    assert floor_point(camera, np.array((4.0, 8.0, 0.0)) - camera) == pytest.approx((4.0, 8.0))
    assert floor_point(camera, (0.0, 1.0, 0.0)) is None  # along the floor
    assert floor_point(camera, (0.0, 0.0, 1.0)) is None  # away from it


@pytest.mark.parametrize(
    ('width', 'height', 'free'),
    [(960, 800, 1.0), (1600, 900, 1.0), (680, 700, 1.0), (524, 390, 1.0), (390, 844, 0.4)],
    ids=['desktop', 'wide', 'narrow', 'telephone on its side', 'telephone'],
)
@pytest.mark.parametrize('name', ['pointmaze-medium-v0', 'pointmaze-giant-v0'])
def test_all_of_the_maze_is_in_view(name: str, width: int, height: int, free: float) -> None:
    """On a telephone held upright, in the upper two fifths: the panel lies over the others."""
    maze = maze_map(name)
    xmin, xmax, ymin, ymax = maze.extent
    wall_m = maze.unit_m / 3
    corners = np.array([(x, y) for x in (xmin, xmax) for y in (ymin, ymax)])
    drawn = np.array(
        [drawn_at(maze, (*corner, z), width, height) for corner in corners for z in (0, wall_m)]
    )
    assert (np.abs(drawn[:, 0]) <= width / 2).all()
    assert (drawn[:, 1] >= -height / 2).all() and (drawn[:, 1] <= height * (free - 0.5)).all()
    assert np.ptp(drawn[:, 0]) > 0.6 * min(width, height), 'it is drawn large enough'
