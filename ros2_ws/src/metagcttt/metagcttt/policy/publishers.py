"""Publishers of the policy node, and the messages they send."""

import time

from builtin_interfaces.msg import Time
from metagcttt_core import Adaptation
from metagcttt_interfaces.msg import ActionCommand, AdaptationReport, PolicyStatus
from rclpy.lifecycle import LifecycleNode
from std_msgs.msg import Header

from metagcttt.converters import action_message, to_floats
from metagcttt.goal_in_force import Goal
from metagcttt.policy.decision import Command, Pursuit, State
from metagcttt.qos import COMMAND, EVENTS, keep_several, LATCHED, RECORDED_DEPTH

STATUS_PERIOD_S = 0.2


def report_message(
    stamp: Time, goal: Goal, adaptation: Adaptation, *, cached: bool = False
) -> AdaptationReport:
    """The report on an adaptation.

    Args:
        stamp: Time of the report.
        goal: The goal that was adapted to.
        adaptation: The result; without a support where the filter did not run.
        cached: The expert was adapted for an earlier goal, so no time was spent on this one.
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
        reason=adaptation.reason,
    )
    if (support := adaptation.support) is not None:
        message.relevant_trajectories = int(support.num_relevant)
        message.kept_trajectories = int(support.num_kept)
        message.transitions = int(support.num_transitions)
        message.filter_ms = 0.0 if cached else float(support.milliseconds)
        message.segment_starts = [int(start) for start, _ in support.segments]
        message.segment_stops = [int(stop) for _, stop in support.segments]
    return message


class PolicyPublishers:
    """Publishes `action`, `adaptation` and `policy_status` while the node is active."""

    def __init__(self, node: LifecycleNode, instance: int) -> None:
        """Create the publishers.

        Args:
            node: The node to publish through.
            instance: Random number that identifies this policy in the graph.
        """
        self._node = node
        self._instance = instance
        self._actions = node.create_lifecycle_publisher(
            ActionCommand, 'action', keep_several(COMMAND, RECORDED_DEPTH)
        )
        self._reports = node.create_lifecycle_publisher(AdaptationReport, 'adaptation', EVENTS)
        self._statuses = node.create_lifecycle_publisher(PolicyStatus, 'policy_status', LATCHED)
        self._last_status = PolicyStatus()
        self._last_status_s = -STATUS_PERIOD_S

    def destroy(self) -> None:
        """Destroy the publishers."""
        for publisher in (self._actions, self._reports, self._statuses):
            self._node.destroy_lifecycle_publisher(publisher)

    def publish_action(self, state: State, command: Command) -> None:
        """Publish the command for a state."""
        self._actions.publish(
            action_message(
                self._node.get_clock().now().to_msg(),
                episode_id=state.episode_id,
                step=state.step,
                query_id=command.query_id,
                values=command.values,
                adapted=command.adapted,
                withheld=bool(command.cause),
                instance=self._instance,
                world_id=state.world_id,
            )
        )

    def publish_report(self, goal: Goal, adaptation: Adaptation, *, cached: bool = False) -> None:
        """Publish and log the result of an adaptation."""
        report = report_message(
            self._node.get_clock().now().to_msg(), goal, adaptation, cached=cached
        )
        self._reports.publish(report)
        verdict = f'adapted in {report.adapt_ms:.0f} ms' if report.accepted else 'not adapted'
        verdict = 'adapted before' if cached else verdict
        self._node.get_logger().info(
            f'goal {goal.query_id}: {report.transitions} transitions from '
            f'{report.kept_trajectories} of {report.relevant_trajectories} trajectories '
            f'in {report.filter_ms:.1f} ms; {verdict}'
            f'{": " if report.reason else ""}{report.reason}'
        )

    def publish_status(self, pursuit: Pursuit | None, state: State | None) -> None:
        """Publish the policy's status when it has changed or is due again."""
        status = PolicyStatus(header=self._last_status.header, instance=self._instance)
        if pursuit is not None:
            status.query_id = pursuit.goal.query_id
            status.episode_id = pursuit.goal.episode_id
            status.steps_done = pursuit.progress.steps_done
            status.steps = pursuit.config.steps
            status.adapted = pursuit.adaptation.accepted
            if pursuit.adapting:
                status.phase = PolicyStatus.ADAPTING
            elif state is not None and pursuit.serves(state):
                status.phase = PolicyStatus.ACTING
            else:
                status.phase = PolicyStatus.WAITING
        now_s = time.monotonic()
        due = now_s - self._last_status_s >= STATUS_PERIOD_S
        if status == self._last_status and not due:
            return
        status.header = Header(stamp=self._node.get_clock().now().to_msg())
        self._last_status, self._last_status_s = status, now_s
        self._statuses.publish(status)
