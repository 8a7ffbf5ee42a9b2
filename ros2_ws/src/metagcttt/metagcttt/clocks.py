"""Time that does not jump."""

from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node

STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""For watchdogs and periods, which go on when simulated time stands still."""

LARGEST_STEP = Duration(seconds=1)


class JumpFreeClock:
    """The time of a node's clock, without its jumps.

    Simulated time starts again with its simulator, jumps with a recording that is played, and
    begins when the first message comes. Ages and durations across such a jump would be hours or
    negative, and time-outs due at once or never, so what jumps is taken out.
    """

    def __init__(self, node: Node) -> None:
        """Follow the clock of a node."""
        self._clock = node.get_clock()
        self._jumped_ns = 0
        self.num_jumps = 0
        self._handle = self._clock.create_jump_callback(
            JumpThreshold(min_forward=LARGEST_STEP, min_backward=Duration(nanoseconds=-1)),
            post_callback=self._on_jump,
        )

    def now_s(self) -> float:
        """Seconds since an arbitrary time; never goes back."""
        return (self._clock.now().nanoseconds - self._jumped_ns) / 1e9

    def close(self) -> None:
        """Stop following the clock."""
        self._handle.unregister()

    def _on_jump(self, jump: TimeJump) -> None:
        self.num_jumps += 1
        self._jumped_ns += jump.delta.nanoseconds
