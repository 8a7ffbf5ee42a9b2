"""Where the driver of the robot with two wheels goes."""

from metagcttt_robots.diffbot_driver import DiffbotDriver
from nav_msgs.msg import OccupancyGrid
import numpy as np
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
