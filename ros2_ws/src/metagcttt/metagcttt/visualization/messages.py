"""Messages for RViz, made from positions by pure functions."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
import math

from geometry_msgs.msg import PoseStamped, Quaternion
from nav_msgs.msg import Odometry, Path
import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from metagcttt.converters import to_point

GOLD = (1.0, 0.84, 0.0, 0.9)
GREY = (0.5, 0.5, 0.5, 0.8)
WHITE = (1.0, 1.0, 1.0, 1.0)
LINE_WIDTH_M = 0.06
TEXT_HEIGHT_M = 0.8


def odometry(
    header: Header, base_frame: str, xy: tuple[float, float], yaw: float, speed: float
) -> Odometry:
    """The odometry of the agent.

    Args:
        header: Time and frame of the position.
        base_frame: Frame of the velocity, the agent's own.
        xy: Position in metres.
        yaw: Direction of travel, radians, counted from x towards y.
        speed: Speed in that direction, metres per second.
    """
    message = Odometry(header=header, child_frame_id=base_frame)
    message.pose.pose.position = to_point(xy)
    message.pose.pose.orientation = Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    message.twist.twist.linear.x = float(speed)
    return message


def path(header: Header, positions: Iterable[tuple[float, float]]) -> Path:
    """The path through positions in metres; its poses face along x."""
    message = Path(header=header)
    for xy in positions:
        pose = PoseStamped(header=header)
        pose.pose.position = to_point(xy)
        pose.pose.orientation.w = 1.0
        message.poses.append(pose)
    return message


def markers(
    header: Header,
    *,
    goal: tuple[float, float] | None,
    radius_m: float,
    segments: Sequence[NDArray[np.floating]],
    value: float | None,
    xy: tuple[float, float],
) -> MarkerArray:
    """Markers of the goal, the sub-trajectories retrieved for it and the value of the state.

    Markers of what is absent are deleted.

    Args:
        header: Time and frame.
        goal: Position of the goal in metres, if there is one.
        radius_m: Distance within which it is reached, metres.
        segments: Sub-trajectories, each (n, 2) in metres.
        value: Value of the current state for the goal, if the policy has a critic.
        xy: The agent's position in metres.
    """
    disc = _marker(header, 'goal', Marker.CYLINDER, GOLD, shown=goal is not None)
    if goal is not None:
        disc.pose.position = to_point(goal)
        disc.scale.x = disc.scale.y = 2.0 * float(radius_m)
        disc.scale.z = 0.1
    lines = _marker(header, 'retrieved', Marker.LINE_LIST, GREY, shown=bool(len(segments)))
    lines.scale.x = LINE_WIDTH_M
    for segment in segments:
        points = [to_point(row) for row in segment]
        for pair in pairwise(points):
            lines.points.extend(pair)
    text = _marker(header, 'value', Marker.TEXT_VIEW_FACING, WHITE, shown=value is not None)
    if value is not None:
        text.pose.position = to_point((xy[0], xy[1] + TEXT_HEIGHT_M))
        text.scale.z = TEXT_HEIGHT_M
        text.text = f'V = {value:.2f}'
    return MarkerArray(markers=[lines, disc, text])


def _marker(
    header: Header, namespace: str, kind: int, color: Sequence[float], *, shown: bool
) -> Marker:
    r, g, b, a = color
    marker = Marker(
        header=header,
        ns=namespace,
        type=kind,
        action=Marker.ADD if shown else Marker.DELETE,
        color=ColorRGBA(r=r, g=g, b=b, a=a),
    )
    marker.pose.orientation.w = 1.0
    return marker


def segments_fault(starts: NDArray[np.integer], stops: NDArray[np.integer], num_rows: int) -> str:
    """The reason why these are not disjoint ranges of a dataset's rows; empty when they are.

    Args:
        starts: First row of each range, shape (n,).
        stops: Row after its last one, shape (m,), with m = n in a sound report.
        num_rows: Rows of the dataset.
    """
    if starts.shape != stops.shape:
        return f'it has {starts.size} starts and {stops.size} stops of sub-trajectories'
    order = np.argsort(starts)
    edges = np.stack([starts[order], stops[order]], axis=1).astype(np.int64).ravel()
    # Also a bound: disjoint ranges have no more rows than the dataset.
    if edges.size and (edges[-1] > num_rows or (np.diff(edges)[::2] < 1).any()):
        return f'a sub-trajectory is empty or not within the {num_rows} rows of the dataset'
    if (np.diff(edges) < 0).any():
        return 'its sub-trajectories overlap'
    return ''


def thinned(
    starts: NDArray[np.integer], stops: NDArray[np.integer], max_points: int
) -> list[NDArray[np.integer]]:
    """Row numbers of sub-trajectories, thinned to about `max_points` in total.

    The last row of each is kept. Those of a single row, which have no line, are dropped, and so
    are the last ones where even two rows of each would be too many.
    """
    stride = max(1, math.ceil(int(np.sum(stops - starts)) / max_points))
    long = [(a, b) for a, b in zip(starts, stops, strict=True) if b - a > 1]
    return [np.append(np.arange(a, b - 1, stride), b - 1) for a, b in long[: max_points // 2]]
