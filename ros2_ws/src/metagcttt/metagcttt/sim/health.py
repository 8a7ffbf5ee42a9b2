"""Health of the simulator bridge."""

import time

from metagcttt.health import Faults, Health, Level, Rate
from metagcttt.input_checks import Senders


class SimMonitor:
    """Collects statistics while a simulator is stepped, and judges its health."""

    def __init__(self) -> None:
        """Start with empty statistics."""
        self.states = Rate()
        self.actions = Rate()
        self.faults = Faults()
        self._senders = Senders()

    def saw_action(self, fault: str, instance: int) -> None:
        """Record an action for this episode.

        Args:
            fault: Why it is ignored; empty when it is used.
            instance: Number of its sender.
        """
        now_s = time.monotonic()
        self._senders.saw(instance, now_s)
        self.actions.add(now_s)
        if fault:
            self.faults.note('malformed_actions', fault, now_s)

    def num_senders(self) -> int:
        """The number of nodes that sent actions for this episode within the last second."""
        return self._senders.count(time.monotonic())

    def examine(self, *, num_publishers: int, action_is_old: bool) -> Health:
        """The current health.

        Args:
            num_publishers: Publishers of actions.
            action_is_old: In realtime: the newest action has timed out and is replaced by zero.
        """
        now_s = time.monotonic()
        values = {
            'state_rate_hz': f'{self.states.per_second(now_s):.1f}',
            'action_rate_hz': f'{self.actions.per_second(now_s):.1f}',
            'action_publishers': str(num_publishers),
            **{kind: str(count) for kind, count in sorted(self.faults.counts.items())},
        }
        level, message = Level.OK, 'stepping'
        if (num_senders := self.num_senders()) > 1:
            level, message = Level.ERROR, f'the action is zero: {num_senders} nodes send actions'
        elif recent := self.faults.recent(now_s):
            level, message = Level.ERROR, f'an action was ignored: {recent}'
        elif num_publishers > 1:
            level, message = Level.WARN, f'{num_publishers} nodes publish actions'
        elif num_publishers == 0:
            level, message = Level.WARN, 'nobody publishes actions'
        elif action_is_old:
            level, message = Level.WARN, 'the action is zero: none was received recently'
        return Health(level, message, values)
