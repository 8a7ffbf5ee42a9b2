"""Obstacles of an occupancy grid, in which no goal can be."""

import math
from typing import Self

from metagcttt_core.robot.contract import GoalMap
from nav_msgs.msg import OccupancyGrid
import numpy as np
from numpy.typing import NDArray

from metagcttt.goal.verdict import Verdict

UNKNOWN = -1


class Obstacles:
    """The cells of a map that are occupied, and where they are.

    Attributes:
        frame_id: Frame of the map.
    """

    def __init__(
        self,
        occupied: NDArray[np.bool_],
        resolution_m: float,
        origin: tuple[float, float, float],
        *,
        frame_id: str,
        clearance_m: float,
    ) -> None:
        """Keep a map.

        Args:
            occupied: Cells that are no place for a goal, shape (rows, columns).
            resolution_m: Edge length of a cell, metres.
            origin: Lower left corner of cell (0, 0) in the frame: x and y in metres, yaw in rad.
            frame_id: The frame.
            clearance_m: Distance to keep from occupied cells, metres.
        """
        self.frame_id = frame_id
        self._occupied = occupied
        self._resolution_m = resolution_m
        self._origin = origin
        self._clearance_m = clearance_m

    @classmethod
    def of(cls, message: OccupancyGrid, settings: GoalMap) -> Self:
        """The obstacles in a message.

        Raises:
            ValueError: If its size, resolution or origin is not usable.
        """
        info = message.info
        shape = (info.height, info.width)
        if not (math.isfinite(info.resolution) and info.resolution > 0):
            raise ValueError(f'the map has a resolution of {info.resolution} m')
        if not len(message.data) == shape[0] * shape[1] > 0:
            raise ValueError(f'the map has {len(message.data)} cells for a size of {shape}')
        place, q = info.origin.position, info.origin.orientation
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
        if not all(map(math.isfinite, (place.x, place.y, yaw))):
            raise ValueError('the origin of the map is not finite')
        cells = np.array(message.data, dtype=np.int8).reshape(shape)
        occupied = cells >= settings.occupied_above
        if not settings.unknown_is_free:
            occupied |= cells == UNKNOWN
        return cls(
            occupied,
            float(info.resolution),
            (place.x, place.y, yaw),
            frame_id=message.header.frame_id,
            clearance_m=settings.clearance_m,
        )

    def refusal(self, x: float, y: float) -> Verdict | None:
        """The reason why (x, y), metres in the map's frame, is no place for a goal; or None."""
        x0, y0, yaw = self._origin
        east = math.cos(yaw) * (x - x0) + math.sin(yaw) * (y - y0)
        north = math.cos(yaw) * (y - y0) - math.sin(yaw) * (x - x0)
        rows, columns = self._occupied.shape
        size = self._resolution_m
        if not (0 <= east < columns * size and 0 <= north < rows * size):
            return Verdict('OUTSIDE_MAZE', f'({x:.2f}, {y:.2f}) is outside the map')
        row, column = np.nonzero(self._occupied)
        # From the point to the nearest place of each occupied cell.
        along = np.maximum(np.abs((column + 0.5) * size - east) - size / 2, 0)
        across = np.maximum(np.abs((row + 0.5) * size - north) - size / 2, 0)
        distance_m = float(np.hypot(along, across).min(initial=math.inf))
        if distance_m > 0 and distance_m >= self._clearance_m:
            return None
        near = f'{distance_m:.2f} m from' if distance_m else 'in'
        keep = f', {self._clearance_m:g} m are to be kept' if distance_m else ''
        return Verdict('IN_WALL', f'({x:.2f}, {y:.2f}) is {near} an obstacle of the map{keep}')
