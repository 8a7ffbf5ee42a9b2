"""A recording as the live view knows a running graph, at any of its times."""

from bisect import bisect_right
from collections import defaultdict
from pathlib import Path
from typing import Any

from metagcttt.parameters import POLICY_NODE
from metagcttt_core.data import DatasetError
from metagcttt_interfaces.msg import PolicyStatus

from metagcttt_tools.live.robots import recorded, Robot
from metagcttt_tools.live.words import health_of, news_of, WAITING
from metagcttt_tools.recordings.bags import read_bag
from metagcttt_tools.recordings.goal_views import maze_of

_TYPES = {
    'map': 'nav_msgs/msg/OccupancyGrid',
    **{
        topic: f'metagcttt_interfaces/msg/{name}'
        for topic, name in (
            ('state', 'MazeState'),
            ('goal', 'GoalQuery'),
            ('adaptation', 'AdaptationReport'),
            ('policy_status', 'PolicyStatus'),
            ('episode', 'EpisodeEvent'),
        )
    },
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}


class Replay:
    """What was known of a robot at one time of a recording; attributes as in `Watch`.

    Attributes:
        duration_s: Length of the recording, without the breaks in it.
    """

    def __init__(self, recording: Path, robot: str, checkpoint: str, dataset: str) -> None:
        """Read the recording.

        Args:
            recording: What recorder_node or `ros2 bag record` wrote.
            robot: Namespace of the robot, such as `/robot1`.
            checkpoint: Policy that acted, which recordings do not name; empty: the committed.
            dataset: What it adapted on; empty: the committed.

        Raises:
            DatasetError: If it cannot be read or has no state of that robot.
        """
        self._robot_name = robot.rstrip('/')
        self._found: dict[str, tuple[list[float], list[Any]]] = defaultdict(lambda: ([], []))
        content = read_bag(recording, _TYPES.values())
        now_s, before = 0.0, None
        for each in content.messages:
            if before is not None and before.stretch == each.stretch:
                now_s += (each.published_ns - before.published_ns) / 1e9
            before = each
            times, messages = self._found[each.topic]
            times.append(now_s)
            messages.append(each.message)
        self.duration_s = now_s
        if not self._times('state'):
            topics = ', '.join(sorted(content.topics)) or 'none'
            raise DatasetError(f'{recording}: no state on {self._name("state")}; topics: {topics}')
        maps = self._found[self._name('map')][1]
        self.grid = maps[-1] if maps else None
        last = self._found[self._name('state')][1][-1]
        known = recorded(maze_of(self.grid), len(last.observation)) if self.grid else None
        self.robot: Robot | None = known or Robot()
        self.policy = {each.name: each.default for each in POLICY_NODE}
        self.policy.update(checkpoint=checkpoint, dataset=dataset)
        self.seek(self._times('state')[0])

    def seek(self, time_s: float) -> None:
        """Go to a time, forwards or backwards."""
        self.time_s = min(max(time_s, 0.0), self.duration_s)
        self.state = self._newest('state')
        self.goal = self._newest('goal')
        self.report = self._newest('adaptation')
        self.status = self._newest('policy_status') or PolicyStatus()
        event = self._newest('episode')
        self.news = news_of(event) if event else WAITING

    def health(self) -> list[tuple[str, int, str]]:
        """Name, level and message of every node that was heard of until now."""
        times, messages = self._found['/diagnostics']
        heard = {
            status.name: (status, at_s)
            for at_s, message in zip(times, messages, strict=True)
            if at_s <= self.time_s
            for status in message.status
            if status.name.rpartition('/')[0] == self._robot_name
        }
        return health_of(heard, self.time_s)

    def _name(self, topic: str) -> str:
        return f'{self._robot_name}/{topic}'

    def _times(self, topic: str) -> list[float]:
        return self._found[self._name(topic)][0]

    def _newest(self, topic: str) -> Any:
        times, messages = self._found[self._name(topic)]
        number = bisect_right(times, self.time_s)
        return messages[number - 1] if number else None
