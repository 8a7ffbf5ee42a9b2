"""The reasons why goals are refused or end."""

from dataclasses import dataclass
from typing import Literal

Error = Literal[
    'NONE',
    'WRONG_FRAME',
    'NOT_FINITE',
    'OUTSIDE_MAZE',
    'IN_WALL',
    'WRONG_SIZE',
    'NO_STATE',
    'EPISODE_OVER',
    'OUTSIDE_DATA',
    'UNKNOWN_VALUE',
    'NO_MAP',
    'PREEMPTED',
    'CANCELED',
    'TIMED_OUT',
    'EPISODE_ENDED',
    'NEW_EPISODE',
    'STATE_LOST',
    'SHUTDOWN',
    'POLICY_LOST',
]
"""The names of the error codes of ReachGoal's result."""


@dataclass(frozen=True)
class Verdict:
    """The reason why a goal is refused, or how it ended: a code and the words."""

    error: Error
    reason: str
