"""QoS profiles of the topics."""

from collections.abc import Sequence

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

SENSOR = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)
"""For streams whose newest value matters and whose lost ones do not."""

COMMAND = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
"""For commands: delivered, and superseded by newer ones."""

LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""For values that hold until they are replaced; late joiners get them too."""

EVENTS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=20,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""For events, which all count, also to late joiners; a depth of 1 would lose the first of two."""


def state_profile(stepping: str) -> QoSProfile:
    """The profile of `state`; in lockstep the simulator waits for the answer to every state."""
    return LATCHED if stepping == 'lockstep' else SENSOR


def state_offer(stepping: str) -> QoSProfile:
    """The profile that the publisher of `state` offers: deep, and reliable for those who ask.

    The nodes ask for less in realtime, where a state that was lost is not worth its repetition.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=RECORDED_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=state_profile(stepping).durability,
    )


RECORDED_DEPTH = 1000
"""Messages kept for a slow reader such as the recorder; in lockstep a second's or more."""


def keep_several(profile: QoSProfile, depth: int = 20) -> QoSProfile:
    """The profile with a larger depth, for one end of a topic on which every message counts.

    With a depth of 1 a newer message replaces one that was not read yet: a slow recorder would
    miss some, and one of two senders would go unnoticed.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=profile.reliability,
        durability=profile.durability,
    )


def recording_profile(publishers: Sequence[QoSProfile]) -> QoSProfile:
    """The strictest profile that all publishers of a topic offer."""
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=RECORDED_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
