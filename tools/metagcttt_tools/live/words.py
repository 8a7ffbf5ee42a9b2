"""Events and the health of nodes in words, whether they arrive now or are replayed."""

from collections.abc import Mapping
from typing import Any

from metagcttt_interfaces.msg import EpisodeEvent

WAITING = 'waiting for the graph'
_SILENT_S = 3.0
_EVENTS = {
    EpisodeEvent.STARTED: 'episode {e.episode_id} began',
    EpisodeEvent.GOAL_ACCEPTED: 'goal {e.query_id} accepted',
    EpisodeEvent.GOAL_REJECTED: 'goal rejected: {e.reason}',
    EpisodeEvent.REACHED: 'goal {e.query_id} reached',
    EpisodeEvent.TIMED_OUT: 'goal {e.query_id} not reached in time',
    EpisodeEvent.ENDED: 'goal {e.query_id} ended: {e.reason}',
}


def news_of(event: Any) -> str:
    """An EpisodeEvent in words."""
    return _EVENTS[event.kind].format(e=event)


def health_of(heard: Mapping[str, tuple[Any, float]], now_s: float) -> list[tuple[str, int, str]]:
    """Name, level and message of each node, given its newest DiagnosticStatus and when it came.

    One that has been silent for 3 s is in error.
    """
    return [
        (name.rpartition('/')[2], 2, 'silent')
        if now_s - heard_s > _SILENT_S
        else (name.rpartition('/')[2], _number(status.level), status.message)
        for name, (status, heard_s) in sorted(heard.items())
    ]


def _number(level: bytes | int) -> int:
    """A byte, which rclpy gives as bytes and readers of recordings as a number."""
    return level[0] if isinstance(level, bytes) else int(level)
