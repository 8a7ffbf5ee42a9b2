"""The visualization node, on which no other node depends."""

from collections import deque
import math
from typing import Any

from metagcttt_core import load_checkpoint, TrajectoryDataset
from metagcttt_core.config.assets import checkpoint_path, dataset_path
from metagcttt_interfaces.msg import AdaptationReport, GoalQuery, MazeState
from nav_msgs.msg import Odometry, Path
import numpy as np
from numpy.typing import NDArray
from sim_bridge import describe_environment
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from metagcttt.clocks import STEADY
from metagcttt.conventions import ConventionalNode
from metagcttt.converters import to_array
from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import VISUALIZATION_NODE
from metagcttt.qos import COMMAND, EVENTS, LATCHED, SENSOR
from metagcttt.visualization.messages import (
    markers,
    odometry,
    path,
    segments_fault,
    thinned,
)

SPACING_M = 0.1


class VisualizationNode(ConventionalNode):
    """Publishes odometry with every state; path and markers, which are large, at a low rate."""

    def __init__(self, **kwargs: Any) -> None:
        """Load the layout of the maze, the dataset and the policy, whose critic is shown.

        Args:
            kwargs: For `rclpy.node.Node`.

        Raises:
            FileNotFoundError: If the committed assets are asked for and missing.
            ValueError: If the environment is unknown or a file is damaged.
        """
        super().__init__('visualization_node', **kwargs)
        self._settings = ParameterSet(self, VISUALIZATION_NODE, is_configured=lambda: True)
        self._spec = describe_environment(self._settings['environment']).spec
        self._dataset = TrajectoryDataset.load(dataset_path(self._settings['dataset']))
        agent = load_checkpoint(checkpoint_path(self._settings['checkpoint']))
        self._value_fn = agent.value_fn if agent.obs_dim == self._spec.obs_dim else None
        self._state: MazeState | None = None
        self._yaw = 0.0
        self._positions: deque[tuple[float, float]] = deque(maxlen=self._settings['path_poses'])
        self._goal: GoalQuery | None = None
        self._segments: list[NDArray[np.floating]] = []
        self._path_changed = self._markers_changed = False

        self._odometry = self.create_publisher(Odometry, 'odom', COMMAND)
        self._path = self.create_publisher(Path, 'path', LATCHED)
        self._markers = self.create_publisher(MarkerArray, 'markers', LATCHED)
        # Best effort matches the publisher in either stepping.
        self.create_subscription(MazeState, 'state', self._on_state, SENSOR)
        self.create_subscription(GoalQuery, 'goal', self._on_goal, LATCHED)
        self.create_subscription(AdaptationReport, 'adaptation', self._on_report, EVENTS)
        self.create_timer(1.0 / self._settings['rate_hz'], self._publish, clock=STEADY)

    def _on_state(self, message: MazeState) -> None:
        xy = (message.position.x, message.position.y)
        if not (math.isfinite(xy[0]) and math.isfinite(xy[1])):
            return
        speed = 0.0
        last, self._state = self._state, message
        if last is None or _episode(last) != _episode(message):
            self._positions.clear()
        else:
            dx, dy = xy[0] - last.position.x, xy[1] - last.position.y
            seconds = _seconds(message.header) - _seconds(last.header)
            if seconds > 0:
                speed = math.hypot(dx, dy) / seconds
            if speed > 0:
                self._yaw = math.atan2(dy, dx)
        frame = self._settings['base_frame_id']
        self._odometry.publish(odometry(message.header, frame, xy, self._yaw, speed))
        if not self._positions or math.dist(xy, self._positions[-1]) >= SPACING_M:
            self._positions.append(xy)
            self._path_changed = True
            self._markers_changed |= self._value_fn is not None

    def _on_goal(self, message: GoalQuery) -> None:
        if self._goal is None or self._goal.query_id != message.query_id:
            self._segments = []
        self._goal = message
        self._markers_changed = True

    def _on_report(self, message: AdaptationReport) -> None:
        starts, stops = np.array(message.segment_starts), np.array(message.segment_stops)
        fault = segments_fault(starts, stops, len(self._dataset.observations))
        if fault:
            self.get_logger().warning(f'a report is ignored: {fault}', throttle_duration_sec=5.0)
            return
        dims = list(self._spec.position_dims)
        rows = thinned(starts, stops, self._settings['marker_points'])
        self._segments = [self._dataset.observations[some[:, None], dims] for some in rows]
        self._markers_changed = True

    def _publish(self) -> None:
        if self._state is None:
            return
        if self._path_changed:
            self._path_changed = False
            self._path.publish(path(self._state.header, self._positions))
        if self._markers_changed:
            self._markers_changed = False
            self._publish_markers(self._state)

    def _publish_markers(self, state: MazeState) -> None:
        goal = self._goal
        active = goal is not None and goal.active and _episode(goal) == _episode(state)
        self._markers.publish(
            markers(
                state.header,
                goal=(goal.position.x, goal.position.y) if goal and active else None,
                radius_m=self._spec.goal_tolerance_m,
                segments=self._segments if active else [],
                value=self._value(state, goal) if goal and active else None,
                xy=(state.position.x, state.position.y),
            )
        )

    def _value(self, state: MazeState, goal: GoalQuery) -> float | None:
        observation, target = to_array(state.observation), to_array(goal.goal)
        size = (self._spec.obs_dim,)
        if self._value_fn is None or observation.shape != size or target.shape != size:
            return None
        return float(self._value_fn(observation[None].astype(np.float32), target)[0])


def _episode(message: MazeState | GoalQuery) -> tuple[int, int]:
    return message.world_id, message.episode_id


def _seconds(header: Header) -> float:
    return header.stamp.sec + 1e-9 * header.stamp.nanosec
