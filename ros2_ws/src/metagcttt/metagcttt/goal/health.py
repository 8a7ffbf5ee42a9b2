"""Health of the goal node."""

from collections import Counter
import time

from metagcttt.goal_in_force import Goal
from metagcttt.health import Faults, Health, Level, Rate


class GoalMonitor:
    """Collects statistics on goals and states, and judges the health of the goal node.

    Attributes:
        counts: Goals that ended or were rejected, by the name of the error; `NONE`: reached.
    """

    def __init__(self) -> None:
        """Start with empty statistics."""
        self.counts: Counter[str] = Counter()
        self._states = Rate()
        self._faults = Faults()
        self._policy_s = float('-inf')

    def saw_state(self, fault: str) -> None:
        """Record a state; `fault` is the reason why it is ignored, empty when it is used."""
        now_s = time.monotonic()
        self._states.add(now_s)
        if fault:
            self._faults.note('unusable_states', fault, now_s)

    def ignored(self, reason: str) -> None:
        """Record a state or the start of an episode that is not of the present."""
        self._faults.note('out_of_order', reason, time.monotonic())

    def saw_policy(self) -> None:
        """Record a status message of the policy."""
        self._policy_s = time.monotonic()

    def examine(self, goal: Goal | None, *, has_source: bool, policy_timeout_s: float) -> Health:
        """The current health.

        Args:
            goal: The goal in force, if any.
            has_source: Whether anybody publishes states.
            policy_timeout_s: Longest silence of the policy while a goal is in force, seconds.
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
            level, message = Level.WARN, 'a goal is in force, but no policy status is received'
        return Health(level, message, values)
