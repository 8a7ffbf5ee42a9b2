"""Conversions between messages and arrays, as pure functions."""

from array import array
from collections.abc import Iterable, Sequence

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from metagcttt_interfaces.msg import ActionCommand, GoalQuery, MazeState
from nav_msgs.msg import OccupancyGrid
import numpy as np
from numpy.typing import ArrayLike, NDArray
from sim_bridge import MazeMap
from std_msgs.msg import Header

from metagcttt.goal_in_force import Goal

OCCUPIED = 100
FREE = 0


def to_floats(values: ArrayLike) -> 'array[float]':
    """Numbers of shape (n,) in the type that a float64[] field takes fastest."""
    floats = array('d')
    floats.frombytes(np.ascontiguousarray(values, dtype=np.float64).tobytes())
    return floats


def to_array(floats: Sequence[float]) -> NDArray[np.float64]:
    """The values of a float64[] field as a new array, shape (n,)."""
    return np.array(floats, dtype=np.float64)


def to_point(xy: Iterable[float]) -> Point:
    """A position (x, y) in metres as a point at height 0."""
    x, y = xy
    return Point(x=float(x), y=float(y), z=0.0)


def to_time(nanoseconds: int) -> Time:
    """A time stamp from nanoseconds."""
    seconds, rest = divmod(nanoseconds, 10**9)
    return Time(sec=seconds, nanosec=rest)


def state_message(
    header: Header,
    *,
    episode_id: int,
    step: int,
    observation: NDArray[np.float64],
    position: tuple[float, float],
    terminated: bool,
    truncated: bool,
    success: bool,
    world_id: int = 0,
    contract: str = '',
) -> MazeState:
    """The state after a control step."""
    return MazeState(
        header=header,
        episode_id=episode_id,
        step=step,
        observation=to_floats(observation),
        position=to_point(position),
        terminated=bool(terminated),
        truncated=bool(truncated),
        success=bool(success),
        world_id=world_id,
        contract=contract,
    )


def action_message(
    stamp: Time,
    *,
    episode_id: int,
    step: int,
    query_id: int,
    values: ArrayLike,
    adapted: bool,
    instance: int = 0,
    world_id: int = 0,
    withheld: bool = False,
) -> ActionCommand:
    """The action for a state."""
    return ActionCommand(
        header=Header(stamp=stamp),
        episode_id=episode_id,
        step=step,
        query_id=query_id,
        values=to_floats(values),
        adapted=bool(adapted),
        instance=instance,
        world_id=world_id,
        withheld=withheld,
    )


def goal_message(header: Header, goal: Goal, *, active: bool, lease_s: float = 0.0) -> GoalQuery:
    """A goal for the policy to act on, or that is over."""
    return GoalQuery(
        header=header,
        query_id=goal.query_id,
        episode_id=goal.episode_id,
        active=active,
        goal=to_floats(goal.observation),
        position=to_point(goal.xy),
        seed=goal.seed,
        lease_s=lease_s,
        world_id=goal.world_id,
    )


def to_goal(message: GoalQuery) -> Goal:
    """The goal of a message."""
    return Goal(
        query_id=message.query_id,
        episode_id=message.episode_id,
        observation=to_array(message.goal),
        xy=(message.position.x, message.position.y),
        seed=message.seed,
        world_id=message.world_id,
    )


def occupancy_grid(maze: MazeMap, header: Header) -> OccupancyGrid:
    """The occupancy grid of a maze; its origin is the lower left corner of cell (0, 0)."""
    grid = OccupancyGrid(header=header)
    xmin, _, ymin, _ = maze.extent
    rows, cols = maze.walls.shape
    grid.info.map_load_time = header.stamp
    grid.info.resolution = float(maze.unit_m)
    grid.info.width = cols
    grid.info.height = rows
    grid.info.origin.position = to_point((xmin, ymin))
    grid.info.origin.orientation.w = 1.0
    cells = np.where(maze.walls, OCCUPIED, FREE).astype(np.int8)
    grid.data = array('b', cells.tobytes())
    return grid
