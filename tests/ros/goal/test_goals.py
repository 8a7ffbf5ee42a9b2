import math

from metagcttt.goal.goals import AcceptedGoal, goal_ending, GoalCatalog, RobotState, Verdict
from metagcttt_core import TrajectoryDataset, TrajectoryFilter
import numpy as np
import pytest
from sim_bridge import describe_environment
from tests.ros.maze_walks import maze_walks

MEDIUM = describe_environment('pointmaze-medium-v0')


@pytest.fixture(scope='module')
def catalog() -> GoalCatalog:
    return GoalCatalog(MEDIUM, TrajectoryFilter(maze_walks('pointmaze-medium-v0')))


@pytest.mark.parametrize('task', MEDIUM.tasks, ids=lambda task: task.name)
def test_goal_of_every_task_is_accepted(catalog: GoalCatalog, task) -> None:
    assert catalog.refusal(*task.goal_xy) is None


@pytest.mark.parametrize(
    ('x', 'y', 'error', 'reason'),
    [
        (math.nan, 0.0, 'NOT_FINITE', 'the position (nan, 0.0) is not finite'),
        (0.0, math.inf, 'NOT_FINITE', 'not finite'),
        (100.0, 0.0, 'OUTSIDE_MAZE', '(100.00, 0.00) is outside the maze, which spans x -6 to 26'),
        (8.0, 0.0, 'IN_WALL', '(8.00, 0.00) is in a wall, cell (1, 3)'),
    ],
)
def test_refusal_names_the_reason(
    catalog: GoalCatalog, x: float, y: float, error: str, reason: str
) -> None:
    refusal = catalog.refusal(x, y)
    assert refusal.error == error
    assert reason in refusal.reason


@pytest.mark.parametrize(
    ('values', 'error'),
    [
        ([4.0], 'WRONG_SIZE'),
        ([4.0, math.nan], 'NOT_FINITE'),
        ([4.0, 1e300], 'NOT_FINITE'),
        ([8.0, 0.0], 'IN_WALL'),
    ],
)
def test_refusal_of_an_observation(catalog: GoalCatalog, values: list, error: str) -> None:
    assert catalog.observation_refusal(np.array(values)).error == error
    assert catalog.observation_refusal(np.array((4.0, 0.0))) is None


def test_goal_observation_is_completed_from_the_nearest_state() -> None:
    ant = describe_environment('antmaze-medium-v0')
    observations = np.arange(3 * 29, dtype=np.float32).reshape(3, 29)
    observations[:, :2] = [(0, 0), (4, 0), (20, 20)]
    data = TrajectoryDataset.from_arrays(
        observations, np.zeros((3, 8)), np.array([False, False, True])
    )
    goal = GoalCatalog(ant, TrajectoryFilter(data)).complete(3.5, 0.25)
    assert goal.dtype == np.float64
    assert goal.tolist() == [3.5, 0.25, *observations[1, 2:].tolist()]


def test_dataset_of_another_robot_is_refused() -> None:
    ant = describe_environment('antmaze-medium-v0')
    with pytest.raises(ValueError, match='observations of 2 values, antmaze-medium-v0 of 29'):
        GoalCatalog(ant, TrajectoryFilter(maze_walks('pointmaze-medium-v0')))


def ending(xy=(9.0, 0.0), step=10, ended=False, success=False, is_task=False, **limits):
    goal = AcceptedGoal(
        query_id=1,
        episode_id=1,
        observation=np.zeros(2),
        xy=(0.0, 0.0),
        seed=0,
        first_step=5,
        is_task=is_task,
        **limits,
    )
    state = RobotState(1, step, xy, ended, success)
    return goal_ending(goal, state, tolerance_m=1.0, max_steps=100)


def test_goal_is_under_way_at_a_distance() -> None:
    assert ending() is None


def test_goal_is_reached_at_exactly_the_tolerance() -> None:
    assert ending(xy=(0.6, 0.8)) == Verdict('NONE', 'after 5 steps, 1.00 m from the goal')
    assert ending(xy=(0.6, 0.81)) is None


def test_task_goal_is_reached_when_the_simulator_says_so() -> None:
    assert ending(xy=(1.1, 0.0), success=True, is_task=True).error == 'NONE'
    assert ending(xy=(1.1, 0.0), success=True, is_task=False) is None


def test_reaching_at_the_last_step_counts() -> None:
    assert ending(xy=(0.0, 0.0), step=105, ended=True).error == 'NONE'


def test_goal_times_out_when_its_steps_are_used_up() -> None:
    assert ending(step=104) is None
    assert ending(step=105) == Verdict(
        'TIMED_OUT', 'not reached in 100 steps, 9.00 m from the goal'
    )


def test_goal_s_own_limit_goes_before_the_node_s() -> None:
    assert ending(step=7, max_steps=3) is None
    assert ending(step=8, max_steps=3).error == 'TIMED_OUT'


def test_goal_times_out_when_the_episode_ends_elsewhere() -> None:
    assert ending(ended=True) == Verdict('EPISODE_ENDED', 'the episode ended 9.00 m from the goal')
