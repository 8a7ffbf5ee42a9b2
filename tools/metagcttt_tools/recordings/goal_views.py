"""Goals in a recording: the robot's path and the data retrieved for each."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from metagcttt_core import TrajectoryDataset
from metagcttt_core.data import DatasetError
import numpy as np
from sim_bridge.maze_map import MazeMap

from metagcttt_tools.recordings.bags import read_bag
from metagcttt_tools.recordings.mcap import Recorded

_GRID = 'nav_msgs/msg/OccupancyGrid'
_STATE = 'metagcttt_interfaces/msg/MazeState'
_GOAL = 'metagcttt_interfaces/msg/GoalQuery'
_REPORT = 'metagcttt_interfaces/msg/AdaptationReport'
_EVENT = 'metagcttt_interfaces/msg/EpisodeEvent'
_REACHED = 3  # EpisodeEvent.REACHED; the recording is read without ROS


@dataclass
class GoalView:
    """One goal of a recording.

    Attributes:
        query_id: Its number.
        goal: (x, y) in metres.
        path: (T, 2) positions from its acceptance to its end, metres.
        segments: The retrieved sub-trajectories, each (n, 2) in metres.
        reached: Whether it was reached.
    """

    query_id: int
    goal: tuple[float, float]
    path: np.ndarray
    segments: list[np.ndarray]
    reached: bool


def read_goal_views(
    recording: Path, dataset: TrajectoryDataset | None, robot: str = ''
) -> tuple[MazeMap, list[GoalView]]:
    """The maze and the goals of one robot, in order.

    Args:
        recording: File or folder of recorder_node.
        dataset: What the robot adapted on; without it nothing retrieved is shown.
        robot: Its namespace, such as `/robot1`.

    Raises:
        DatasetError: If the file cannot be read or has no map, state or goal of that robot.
    """
    content = read_bag(recording, (_GRID, _STATE, _GOAL, _REPORT, _EVENT))
    by_type: dict[str, list[Any]] = {name: [] for name in (_GRID, _REPORT, _EVENT)}
    for recorded in content.messages:
        if recorded.topic.rpartition('/')[0] == robot and recorded.type_name in by_type:
            by_type[recorded.type_name].append(recorded.message)
    if not by_type[_GRID]:
        raise DatasetError(
            f'{recording}: no map on {robot}/map; topics: {", ".join(content.topics)}'
        )
    reports = {report.query_id: report for report in by_type[_REPORT]}
    reached = {event.query_id for event in by_type[_EVENT] if event.kind == _REACHED}
    views = [
        GoalView(
            query_id=query.query_id,
            goal=(query.position.x, query.position.y),
            path=np.array(path),
            segments=_segments(reports.get(query.query_id), dataset),
            reached=query.query_id in reached,
        )
        for query, path in _paths(content.messages, robot)
    ]
    if not views:
        raise DatasetError(f'{recording}: no goal was in force while {robot}/state was recorded')
    try:
        return maze_of(by_type[_GRID][-1]), views
    except ValueError as error:
        raise DatasetError(f'{recording}: the map on {robot}/map is false ({error})') from error


def _paths(
    messages: Sequence[Recorded], robot: str
) -> list[tuple[Any, list[tuple[float, float]]]]:
    """Each goal with the positions while it was in force, both in the order of publication."""
    found: list[tuple[Any, list[tuple[float, float]]]] = []
    query, position = None, None
    for recorded in messages:
        message = recorded.message
        if recorded.topic == f'{robot}/goal' and recorded.type_name == _GOAL:
            query = message if message.active else None
            if query is not None and position is not None:
                found.append((query, [position]))
        elif recorded.topic == f'{robot}/state' and recorded.type_name == _STATE:
            position = (message.position.x, message.position.y)
            if query is None or message.episode_id != query.episode_id:
                continue
            if not found or found[-1][0] is not query:
                found.append((query, []))
            found[-1][1].append(position)
    return found


def _segments(report: Any, dataset: TrajectoryDataset | None) -> list[np.ndarray]:
    if report is None or dataset is None:
        return []
    rows = zip(report.segment_starts, report.segment_stops, strict=True)
    return [dataset.observations[start:stop, :2] for start, stop in rows]


def maze_of(grid: Any) -> MazeMap:
    """The walls of an OccupancyGrid, whose origin is the corner of cell (0, 0)."""
    info = grid.info
    half = info.resolution / 2
    return MazeMap(
        walls=np.array(grid.data).reshape(info.height, info.width) > 0,
        unit_m=info.resolution,
        origin_xy=(info.origin.position.x + half, info.origin.position.y + half),
    )
