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

MAX_REASON = 1000


@dataclass(frozen=True)
class Verdict:
    """The reason why a goal is refused, or how it ended: a code and the words.

    Words that repeat what was sent are cut at `MAX_REASON` characters: events and results are kept
    for those who join late, and a name of megabytes would be kept with them.
    """

    error: Error
    reason: str

    def __post_init__(self) -> None:
        """Cut the words."""
        if len(self.reason) > MAX_REASON:
            object.__setattr__(self, 'reason', f'{self.reason[:MAX_REASON]}...')
