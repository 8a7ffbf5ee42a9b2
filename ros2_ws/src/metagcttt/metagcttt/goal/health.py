"""How a goal node is. No ROS in here."""

from collections import Counter
import time

from metagcttt.goal.goals import Goal
from metagcttt.health import Faults, Health, Level, Rate


class GoalMonitor:
    """Gathers figures while goals come and go, and judges them.

    Attributes:
        counts: Goals that ended or were refused, by the name of the error; `NONE`: reached.
    """

    def __init__(self) -> None:
        """Nothing has happened yet."""
        self.counts: Counter[str] = Counter()
        self._states = Rate()
        self._faults = Faults()
        self._policy_s = float('-inf')

    def saw_state(self, fault: str) -> None:
        """A state arrived; `fault` says why it is not used."""
        now_s = time.monotonic()
        self._states.add(now_s)
        if fault:
            self._faults.note('unusable_states', fault, now_s)

    def saw_policy(self) -> None:
        """The policy said that it is there."""
        self._policy_s = time.monotonic()

    def examine(self, goal: Goal | None, *, has_source: bool, policy_timeout_s: float) -> Health:
        """The health now.

        Args:
            goal: The goal in force, if any.
            has_source: Whether anybody publishes states.
            policy_timeout_s: How long a policy may be silent while there is a goal, seconds.
        """
        now_s = time.monotonic()
        values = {
            'state_rate_hz': f'{self._states.per_second(now_s):.1f}',
            'goal': str(goal.query_id if goal else 0),
            **{kind: str(count) for kind, count in sorted(self._faults.counts.items())},
            **{f'goals_{error.lower()}': str(n) for error, n in sorted(self.counts.items())},
        }
        level, message = Level.OK, f'goal {goal.query_id} in force' if goal else 'no goal'
        if not has_source:
            level, message = Level.ERROR, 'nobody publishes states'
        elif recent := self._faults.recent(now_s):
            level, message = Level.ERROR, f'a state was ignored: {recent}'
        elif goal and now_s - self._policy_s > policy_timeout_s:
            level, message = Level.WARN, 'a goal is in force, but no policy is to be heard'
        return Health(level, message, values)
