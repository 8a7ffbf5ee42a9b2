"""Plans of mazes: geometry, refusals and shortest ways."""

import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from sim_bridge import maze_map, MazeMap

MAZE = MazeMap.from_rows(
    (
        '######',
        '#..#.#',
        '#.##.#',
        '#....#',
        '######',
    ),
    unit_m=2.0,
    origin_xy=(-1.0, 3.0),
)


@st.composite
def mazes(draw: st.DrawFn) -> MazeMap:
    rows, cols = draw(st.integers(1, 7)), draw(st.integers(1, 7))
    cells = st.lists(st.sampled_from('#.'), min_size=cols, max_size=cols).map(''.join)
    text = draw(st.lists(cells, min_size=rows, max_size=rows))
    origin = st.floats(-50, 50)
    return MazeMap.from_rows(
        text, unit_m=draw(st.floats(0.25, 9.0)), origin_xy=(draw(origin), draw(origin))
    )


@given(maze=mazes(), data=st.data())
def test_center_of_a_cell_lies_in_that_cell(maze: MazeMap, data: st.DataObject) -> None:
    cell = (
        data.draw(st.integers(0, maze.walls.shape[0] - 1)),
        data.draw(st.integers(0, maze.walls.shape[1] - 1)),
    )
    assert maze.cell(*maze.center(*cell)) == cell
    assert maze.is_free(*maze.center(*cell)) == (not maze.walls[cell])


@given(maze=mazes(), u=st.floats(0, 1), v=st.floats(0, 1))
def test_point_lies_within_half_a_unit_of_its_cells_center(
    maze: MazeMap, u: float, v: float
) -> None:
    xmin, xmax, ymin, ymax = maze.extent
    x, y = xmin + u * (xmax - xmin), ymin + v * (ymax - ymin)
    if not maze.contains(x, y):  # the upper edges belong to no cell
        assert u > 0.999 or v > 0.999
        return
    center = maze.center(*maze.cell(x, y))
    assert abs(center[0] - x) <= maze.unit_m / 2 * (1 + 1e-9)
    assert abs(center[1] - y) <= maze.unit_m / 2 * (1 + 1e-9)


@given(maze=mazes(), x=st.floats(allow_nan=True), y=st.floats(allow_nan=True))
def test_any_point_is_either_contained_or_refused(maze: MazeMap, x: float, y: float) -> None:
    if maze.contains(x, y):
        i, j = maze.cell(x, y)
        assert maze.is_free(x, y) == (not maze.walls[i, j])
    else:
        assert not maze.is_free(x, y)
        with pytest.raises(ValueError, match='lies outside the maze'):
            maze.cell(x, y)


def test_rows_run_along_y_and_columns_along_x() -> None:
    assert MAZE.center(0, 0) == (-1.0, 3.0)
    assert MAZE.center(1, 2) == (3.0, 5.0)
    assert MAZE.extent == (-2.0, 10.0, 2.0, 12.0)


def test_a_cell_owns_its_lower_edge_and_not_its_upper() -> None:
    assert MAZE.cell(-2.0, 2.0) == (0, 0)
    assert MAZE.cell(0.0, 4.0) == (1, 1)
    assert MAZE.cell(-1e-9, 4.0) == (1, 0)
    assert not MAZE.contains(10.0, 5.0)
    assert MAZE.cell(math.nextafter(10.0, 0), 5.0) == (1, 5)


def test_missing_cell_is_refused() -> None:
    with pytest.raises(ValueError, match=r'cell \(5, 0\) does not exist; .* 5 x 6 cells'):
        MAZE.center(5, 0)
    with pytest.raises(ValueError, match=r'cell \(0, -1\) does not exist'):
        MAZE.distances((0, -1))


def test_walls_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match='read-only'):
        MAZE.walls[0, 0] = False
    with pytest.raises(ValueError, match='read-only'):
        MAZE.distances((1, 1))[0, 0] = 0


@pytest.mark.parametrize(
    ('rows', 'message'),
    [
        (('##', '#'), r'equally long, got \[2, 1\]'),
        (('#x',), r"only '#' and '\.', got \['x'\]"),
        (('',), 'rows and columns'),
    ],
)
def test_malformed_text_is_refused(rows: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MazeMap.from_rows(rows, unit_m=1.0, origin_xy=(0.0, 0.0))


@pytest.mark.parametrize('unit_m', [0.0, -1.0, math.nan, math.inf])
def test_unusable_unit_is_refused(unit_m: float) -> None:
    with pytest.raises(ValueError, match='unit_m must be a positive length'):
        MazeMap.from_rows(('.',), unit_m=unit_m, origin_xy=(0.0, 0.0))


def test_distances_are_counted_by_hand() -> None:
    expected = [
        [-1, -1, -1, -1, -1, -1],
        [-1, 0, 1, -1, 7, -1],
        [-1, 1, -1, -1, 6, -1],
        [-1, 2, 3, 4, 5, -1],
        [-1, -1, -1, -1, -1, -1],
    ]
    np.testing.assert_array_equal(MAZE.distances((1, 1)), expected)
    assert MAZE.cells_at_distance((1, 1), 1) == [(1, 2), (2, 1)]
    assert MAZE.cells_at_distance((1, 1), 9) == []


def test_open_cells_leave_out_corridors_and_keep_corners_and_dead_ends() -> None:
    # (2, 1), (3, 2), (3, 3) and (2, 4) are passed straight through.
    assert MAZE.open_cells() == [(1, 1), (1, 2), (1, 4), (3, 1), (3, 4)]


@given(maze=mazes(), data=st.data())
def test_next_cell_comes_one_step_nearer_or_stays(maze: MazeMap, data: st.DataObject) -> None:
    free = maze.free_cells()
    if not free:
        return
    start, target = data.draw(st.sampled_from(free)), data.draw(st.sampled_from(free))
    table = maze.distances(target)
    step = maze.next_cell(start, target)
    if table[start] <= 0:  # there already, or no way
        assert step == start
    else:
        assert table[step] == table[start] - 1
        assert abs(step[0] - start[0]) + abs(step[1] - start[1]) == 1


def test_count_visits_agrees_with_cell() -> None:
    rng = np.random.default_rng(0)
    xmin, xmax, ymin, ymax = MAZE.extent
    points = rng.uniform((xmin, ymin), (xmax, ymax), size=(500, 2))
    expected = np.zeros(MAZE.walls.shape, dtype=int)
    for x, y in points:
        expected[MAZE.cell(x, y)] += 1
    np.testing.assert_array_equal(MAZE.count_visits(points), expected)


def test_count_visits_refuses_a_point_outside() -> None:
    with pytest.raises(ValueError, match=r'point \(99.0, 3.0\) lies outside'):
        MAZE.count_visits(np.array([[0.0, 3.0], [99.0, 3.0]]))


def test_ogbench_cell_centers_are_where_its_documentation_puts_them() -> None:
    maze = maze_map('pointmaze-medium-v0')
    for i, j in maze.free_cells():
        assert maze.center(i, j) == (4.0 * (j - 1), 4.0 * (i - 1))
