"""Conversions between adaptations and the messages that carry them, as pure functions."""

from array import array

from builtin_interfaces.msg import Time
from metagcttt_core import Adaptation, Agent, TrajectoryDataset, TTTConfig
from metagcttt_core.adaptation.weights import changed_weights, with_weights
from metagcttt_core.retrieval.peaks import ranges
from metagcttt_core.retrieval.support import SupportSet
from metagcttt_interfaces.msg import AdaptationReport, Expert
from metagcttt_interfaces.srv import Adapt
import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Header

from metagcttt.converters import goal_message, to_floats
from metagcttt.deployment import Identity
from metagcttt.goal_in_force import Goal


class ExpertError(ValueError):
    """The message of an adapter is no expert for the request; says why."""


def report_message(
    stamp: Time,
    goal: Goal,
    adaptation: Adaptation,
    *,
    cached: bool = False,
    remark: str = '',
) -> AdaptationReport:
    """The report on an adaptation.

    Args:
        stamp: Time of the report.
        goal: The goal that was adapted to.
        adaptation: The result; without a support where the filter did not run.
        cached: The expert was adapted for an earlier goal, so no time was spent on this one.
        remark: What else there is to say about it.
    """
    message = AdaptationReport(
        header=Header(stamp=stamp),
        query_id=goal.query_id,
        episode_id=goal.episode_id,
        adapt_ms=0.0 if cached else 1000.0 * adaptation.seconds,
        steps=len(adaptation.train_losses),
        train_losses=to_floats(adaptation.train_losses),
        test_losses=to_floats(adaptation.test_losses),
        best_step=int(adaptation.best_step),
        accepted=bool(adaptation.accepted),
        cached=cached,
        reason=adaptation.reason or remark,
        adapter=adaptation.adapter,
    )
    if (support := adaptation.support) is not None:
        message.relevant_trajectories = int(support.num_relevant)
        message.kept_trajectories = int(support.num_kept)
        message.transitions = int(support.num_transitions)
        message.filter_ms = 0.0 if cached else float(support.milliseconds)
        message.segment_starts = [int(start) for start, _ in support.segments]
        message.segment_stops = [int(stop) for _, stop in support.segments]
    return message


def request_message(
    *,
    robot: str,
    instance: int,
    request_id: int,
    timeout_s: float,
    identity: Identity,
    observation: NDArray[np.float64],
    goal: Goal,
    config: TTTConfig,
) -> Adapt.Request:
    """A request for the expert of a goal; the fields are those of the message."""
    return Adapt.Request(
        robot=robot,
        instance=instance,
        request_id=request_id,
        timeout_s=timeout_s,
        checkpoint=identity.checkpoint,
        dataset=identity.dataset,
        filter=identity.filter,
        observation=to_floats(observation),
        query=goal_message(Header(), goal, active=True),
        settings=config.model_dump_json(),
    )


def expert_message(base: Agent, goal: Goal, adaptation: Adaptation) -> Expert:
    """The expert that an adaptation of `base` came to; who asked is filled in by the sender."""
    support = adaptation.support
    weights = changed_weights(base, adaptation.agent) if adaptation.accepted else b''
    return Expert(
        status=Expert.DONE,
        weights=array('B', weights),
        report=report_message(Time(), goal, adaptation),
        engine=adaptation.engine,
        scored_trajectories=0 if support is None else int(support.num_scored),
        scores=to_floats([] if support is None else support.scores),
    )


def to_adaptation(
    message: Expert, base: Agent, dataset: TrajectoryDataset, config: TTTConfig, adapter: str
) -> Adaptation:
    """The adaptation that an expert is the result of; the inverse of `expert_message`.

    Args:
        message: The expert, from anywhere.
        base: The base policy that it was adapted from.
        dataset: The dataset that it was adapted on.
        config: The inner loop that was asked for.
        adapter: Name of the service.

    Raises:
        ExpertError: If weights or figures cannot be those of the adaptation that was asked for.
    """
    report = message.report
    support = _support(message, dataset)
    steps = config.steps if report.accepted else report.steps
    expected = {
        'steps': (report.steps, steps),
        'train_losses': (len(report.train_losses), steps),
        'test_losses': (len(report.test_losses), steps + 1 if report.test_losses else 0),
        'accepted': (report.accepted, report.best_step > 0),
        'best_step': (report.best_step, min(report.best_step, steps)),
    }
    for name, (found, right) in expected.items():
        if found != right:
            raise ExpertError(f'the report has {name} {found} for {right}')
    agent = base
    if report.accepted:
        try:
            agent = with_weights(base, bytes(message.weights)) if message.weights else base.clone()
        except ValueError as error:
            raise ExpertError(str(error)) from error
    elif message.weights:
        raise ExpertError('weights of an expert that is not accepted')
    return Adaptation(
        agent,
        list(report.train_losses),
        list(report.test_losses),
        best_step=report.best_step,
        reason='' if report.accepted else report.reason or 'not accepted by the adapter',
        engine=message.engine,
        support=support,
        seconds=report.adapt_ms / 1000,
        adapter=adapter,
    )


def _support(message: Expert, dataset: TrajectoryDataset) -> SupportSet:
    """The support set of an expert; its sub-trajectories ascend and do not overlap."""
    report = message.report
    starts, stops = (
        np.array(rows, np.int64) for rows in (report.segment_starts, report.segment_stops)
    )
    if not len(starts) == len(stops) == len(message.scores) == report.kept_trajectories:
        raise ExpertError('the report has other numbers of sub-trajectories than it says')
    edges = np.stack([starts, stops], axis=-1).reshape(-1)
    if (np.diff(edges) < 0).any() or (edges[-1:] > dataset.num_rows).any():
        raise ExpertError('the report has sub-trajectories that are none of the dataset')
    if (stops - starts).sum() != report.transitions:
        raise ExpertError('the report has another number of transitions than it says')
    return SupportSet(
        indices=ranges(starts, stops),
        segments=list(zip(starts.tolist(), stops.tolist(), strict=True)),
        episodes=dataset.episode_of(starts),
        scores=np.array(message.scores, np.float64),
        num_relevant=report.relevant_trajectories,
        num_scored=message.scored_trajectories,
        milliseconds=report.filter_ms,
    )
