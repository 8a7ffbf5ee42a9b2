"""What became of an adaptation, as a message. Apart from `converters`, as it needs PyTorch."""

from builtin_interfaces.msg import Time
from metagcttt_core import Adaptation, SupportSet
from metagcttt_interfaces.msg import AdaptationReport
from std_msgs.msg import Header

from metagcttt.converters import to_floats


def report_message(
    stamp: Time,
    *,
    query_id: int,
    episode_id: int,
    support: SupportSet | None,
    adaptation: Adaptation | None,
    reason: str = '',
    cached: bool = False,
) -> AdaptationReport:
    """What became of one query.

    Args:
        stamp: Time of the report.
        query_id: The query.
        episode_id: Its episode.
        support: What the filter found; None when it did not run.
        adaptation: What the inner loop made of it; None when it did not end.
        reason: Why there is no adaptation; otherwise the adaptation's own reason is taken.
        cached: The adaptation was made for an earlier query; no time was spent on this one.
    """
    message = AdaptationReport(
        header=Header(stamp=stamp), query_id=query_id, episode_id=episode_id, reason=reason
    )
    if support is not None:
        message.relevant_trajectories = int(support.num_relevant)
        message.kept_trajectories = int(support.num_kept)
        message.transitions = int(support.num_transitions)
        message.filter_ms = 0.0 if cached else float(support.milliseconds)
        message.segment_starts = [int(start) for start, _ in support.segments]
        message.segment_stops = [int(stop) for _, stop in support.segments]
    if adaptation is not None:
        message.adapt_ms = 0.0 if cached else 1000.0 * adaptation.seconds
        message.cached = cached
        message.steps = len(adaptation.train_losses)
        message.train_losses = to_floats(adaptation.train_losses)
        message.test_losses = to_floats(adaptation.test_losses)
        message.best_step = int(adaptation.best_step)
        message.accepted = bool(adaptation.accepted)
        message.reason = adaptation.reason
    return message
