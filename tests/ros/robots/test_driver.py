"""Where the drivers of the simulated robots go."""

from metagcttt_robots.arm_driver import ArmDriver, HIGH, LOW
from metagcttt_robots.diffbot_driver import DiffbotDriver
from nav_msgs.msg import OccupancyGrid
import numpy as np
import pytest
from tests.ros.graph import Graph

PLACES = np.array([[-3.0, 3.0], [3.0, 3.0], [0.25, 1.75]])


def ends_of_paths(graph: Graph, **parameters: list[float]) -> np.ndarray:
    """Where twenty paths end, each from the end of the one before, in an empty room."""
    room = OccupancyGrid()
    room.info.resolution, room.info.width, room.info.height = 0.1, 80, 80
    room.info.origin.position.x = room.info.origin.position.y = -4.0
    room.data = [0] * 6400
    driver = graph.add(DiffbotDriver, **parameters)
    driver._on_map(room)
    ends = [PLACES[0]]
    for _ in range(20):
        driver._plan(ends[-1])
        ends.append(driver._path[-1])
    return np.array(ends)


def test_driver_goes_from_place_to_another_place(graph: Graph) -> None:
    ends = ends_of_paths(graph, places=PLACES.ravel().tolist())
    distances = np.linalg.norm(ends[:, None] - PLACES, axis=2)
    assert distances.min(axis=1).max() < 0.1  # in its cell of 0.1 m
    visited = distances.argmin(axis=1)
    assert (np.diff(visited) != 0).all()
    assert set(visited) == {0, 1, 2}


def test_driver_goes_anywhere_without_places(graph: Graph) -> None:
    assert len(np.unique(ends_of_paths(graph).round(1), axis=0)) > 15


POSTURES = np.array([[-1.2, 0.2, -0.8, 0.0], [1.2, 0.9, -1.2, 0.3], [1.0, 0.0, -1.6, 0.8]])


def ends_of_ways(graph: Graph, **parameters: list[float]) -> np.ndarray:
    """Where twenty ways of the arm end, each from the end of the one before."""
    driver = graph.add(ArmDriver, **parameters)
    ends = [POSTURES[0]]
    for _ in range(20):
        way = driver._plan(ends[-1])
        if ends[-1][0] * way[-1][0] < 0:  # over the post
            assert [point[1] for point in way[:-1]] == [1.1, 1.1]
        ends.append(way[-1])
    return np.array(ends)


def test_arm_goes_from_place_to_another_place(graph: Graph) -> None:
    ends = ends_of_ways(graph, places=POSTURES.ravel().tolist())
    distances = np.abs(ends[:, None] - POSTURES).max(axis=2)
    assert distances.min(axis=1).max() == 0
    visited = distances.argmin(axis=1)
    assert (np.diff(visited) != 0).all()
    assert set(visited) == {0, 1, 2}


def test_arm_goes_anywhere_without_places(graph: Graph) -> None:
    ends = ends_of_ways(graph)
    assert len(np.unique(ends, axis=0)) == 21
    assert ((ends >= LOW) & (ends <= HIGH)).all()


@pytest.mark.parametrize(
    ('places', 'complaint'),
    [([0.1] * 6, 'needs 4 numbers each, got 6'), ([9.0] * 4, r'from \[-1.4, .* got \[9.0')],
)
def test_places_that_the_arm_cannot_take_are_refused(
    graph: Graph, places: list[float], complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        graph.add(ArmDriver, places=places)
