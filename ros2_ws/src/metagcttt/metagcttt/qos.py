"""The qualities of service that the topics use."""

from collections.abc import Sequence

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

SENSOR = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)
"""The newest value matters, a lost one does not."""

COMMAND = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
"""Arrives, but a newer one wins."""

LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""What holds until it is replaced; whoever joins later gets it too."""

EVENTS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=20,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Every one counts, also the few before one joined; a depth of 1 would lose the first of two."""


def state_profile(stepping: str) -> QoSProfile:
    """The profile of `state`: in lockstep the world stands still until a state is answered."""
    return LATCHED if stepping == 'lockstep' else SENSOR


RECORDED_DEPTH = 1000
"""Messages that wait for a recorder: in lockstep those of a second or more."""


def keep_several(profile: QoSProfile, depth: int = 20) -> QoSProfile:
    """The same with a larger depth, for one end of a topic on which every message counts.

    With a depth of 1 a newer message takes the place of one that was not read yet: a slow recorder
    would miss some, and of two senders one would not be noticed.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=profile.reliability,
        durability=profile.durability,
    )


def recording_profile(publishers: Sequence[QoSProfile]) -> QoSProfile:
    """The best quality that all publishers of a topic offer; nothing waits to be taken in vain."""
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=RECORDED_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
