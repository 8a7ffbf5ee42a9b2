"""Policy health."""

import time

from metagcttt_core import Adaptation

from metagcttt.health import Deadlines, Faults, Health, Level, Rate, Samples
from metagcttt.policy.decision import Pursuit


class PolicyMonitor:
    """Collects statistics while a policy runs and judges its health.

    Attributes:
        adapter: Name of the service that adapts; empty where this node does.
        num_fallbacks: Goals for which that service had no expert.
    """

    def __init__(self, engine: str) -> None:
        """Start with empty statistics.

        Args:
            engine: What computes gradient steps; `Adaptation.engine`.
        """
        self.engine = engine
        self.adapter = ''
        self.num_fallbacks = 0
        self._num_remote = 0
        self.states = Rate()
        self.actions = Rate()
        self.latency_ms = Samples()
        self.adapt_ms = Samples(100)
        self.deadlines = Deadlines()
        self.faults = Faults()

    def adapted(self, adaptation: Adaptation) -> None:
        """Record an adaptation that ended without an error."""
        self.adapt_ms.add(1000 * adaptation.seconds)
        self.engine = adaptation.engine or self.engine
        self._num_remote += bool(adaptation.adapter)

    def examine(
        self,
        *,
        acting: bool,
        zero_reason: str,
        pursuit: Pursuit | None,
        num_publishers: int,
        num_pending: int,
        warn_latency_ms: float,
        warn_missed_deadlines: int,
        warn_adapt_ms: float,
    ) -> Health:
        """The current health.

        Args:
            acting: Whether the node is active.
            zero_reason: Why the action is zero although the node is active; empty when it is not.
            pursuit: The work on the goal in force, if there is one.
            num_publishers: Publishers of actions in the graph, this one included.
            num_pending: Jobs whose result was not handled yet.
            warn_latency_ms: Threshold of the 99th percentile of the time from state to action.
            warn_missed_deadlines: Threshold of control periods missed in the last minute.
            warn_adapt_ms: Threshold of the duration of the last adaptation.
        """
        now_s = time.monotonic()
        missed = self.deadlines.in_last_minute(now_s)
        latency_ms = self.latency_ms.percentile(99)
        base_reason = _base_reason(pursuit)
        values = {
            'state_rate_hz': f'{self.states.per_second(now_s):.1f}',
            'action_rate_hz': f'{self.actions.per_second(now_s):.1f}',
            'latency_median_ms': f'{self.latency_ms.percentile(50):.2f}',
            'latency_p99_ms': f'{latency_ms:.2f}',
            'missed_deadlines': str(self.deadlines.total),
            'missed_deadlines_last_minute': str(missed),
            'adapt_engine': self.engine,
            'adapt_last_ms': f'{self.adapt_ms.last():.1f}',
            'adapt_p99_ms': f'{self.adapt_ms.percentile(99):.1f}',
            'adaptations_pending': str(num_pending),
            'action_publishers': str(num_publishers),
            **self._adapter_values(),
            **{kind: str(count) for kind, count in sorted(self.faults.counts.items())},
        }
        level, message = Level.OK, 'acting with the adapted policy'
        if not acting:
            message = 'not active'
        elif zero_reason:
            level, message = Level.ERROR, f'the action is zero: {zero_reason}'
        elif recent := self.faults.recent(now_s):
            level, message = Level.ERROR, f'just now: {recent}'
        elif num_publishers > 1:
            level, message = Level.WARN, f'{num_publishers} nodes publish actions'
        elif latency_ms > warn_latency_ms:
            level, message = Level.WARN, f'99 % of actions within {latency_ms:.1f} ms only'
        elif missed > warn_missed_deadlines:
            level, message = Level.WARN, f'{missed} deadlines missed in the last minute'
        elif self.adapt_ms.last() > warn_adapt_ms:
            level, message = Level.WARN, f'the adaptation took {self.adapt_ms.last():.0f} ms'
        elif pursuit is None:
            message = 'no goal'
        elif base_reason:
            level, message = Level.WARN, f'acting with the base policy: {base_reason}'
        elif pursuit.fallback:
            level, message = Level.WARN, f'without the adapter: {pursuit.fallback}'
        return Health(level, message, values)

    def _adapter_values(self) -> dict[str, str]:
        if not self.adapter:
            return {}
        return {
            'adapter': self.adapter,
            'adapter_experts': str(self._num_remote),
            'adapter_fallbacks': str(self.num_fallbacks),
        }


def _base_reason(pursuit: Pursuit | None) -> str:
    """The reason why the base policy serves the goal; empty when the expert does."""
    if pursuit is None or pursuit.adaptation.accepted:
        return ''
    if pursuit.adapting:
        return f'{pursuit.progress.steps_done} of {pursuit.config.steps} gradient steps done'
    return pursuit.adaptation.reason
