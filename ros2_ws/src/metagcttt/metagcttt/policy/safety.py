"""The conditions under which a policy has to keep the robot still."""

from metagcttt.input_checks import Senders
from metagcttt.policy.decision import State


class Safety:
    """Tracks the reasons for a zero action; each ends with its cause.

    Attributes:
        enabled: Whether the robot may move at all.
        rivals: Other policies in the graph.
        expired_goal: Why the goal in force was dropped; empty from the next goal on.
    """

    def __init__(self, *, enabled: bool) -> None:
        """Start without states, goals and other policies."""
        self.enabled = enabled
        self.rivals = Senders()
        self.expired_goal = ''
        self._out_of_order = ''
        self._state_s = self._state_clock_s = float('inf')
        self._lease_s = self._lease_end_s = float('inf')

    def saw_state(self, now_s: float, clock_s: float, out_of_order: str = '') -> None:
        """Record the arrival of a state.

        Args:
            now_s: The time now, seconds of a monotonic clock.
            clock_s: The same by the node's clock, which may be simulated and paused.
            out_of_order: Why the state is not used; the robot rests until one in order comes.
        """
        self._state_s, self._state_clock_s = now_s, clock_s
        self._out_of_order = out_of_order

    def saw_goal(self, now_s: float, lease_s: float) -> None:
        """Record a goal or its repetition; it expires `lease_s` later, never with 0."""
        self.expired_goal = ''
        self._lease_s = lease_s
        self._lease_end_s = now_s + lease_s if lease_s > 0 else float('inf')

    def expire_goal(self, query_id: int, now_s: float) -> bool:
        """Drop the goal in force, for the reason kept, and return true if its lease ran out."""
        if now_s <= self._lease_end_s:
            return False
        self.expired_goal = (
            f'goal {query_id} was not repeated for {self._lease_s:g} s and is dropped'
        )
        return True

    def zero_reason(
        self, state: State | None, *, now_s: float, clock_s: float, timeout_s: float
    ) -> str:
        """The reason why the robot may not move now; empty when it may.

        Args:
            state: The newest state.
            now_s: See `saw_state`.
            clock_s: See `saw_state`.
            timeout_s: Oldest age of a state to act on, seconds.
        """
        age_s = max(now_s - self._state_s, clock_s - self._state_clock_s)
        if not self.enabled:
            return 'disabled by the service enable'
        if self.rivals.count(now_s):
            return 'another policy node acts in this graph'
        if self.expired_goal:
            return self.expired_goal
        if age_s > timeout_s:
            return f'no state for {age_s:.1f} s'
        if self._out_of_order:
            return self._out_of_order
        return state.fault if state is not None else ''
