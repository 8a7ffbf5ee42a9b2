"""What the policy publishes."""

import time

from metagcttt_interfaces.msg import ActionCommand, AdaptationReport, PolicyStatus
from rclpy.lifecycle import LifecycleNode
from std_msgs.msg import Header

from metagcttt.converters import action_message
from metagcttt.policy.adaptation_report import report_message
from metagcttt.policy.deployment import Outcome
from metagcttt.policy.pilot import Command, Query, State
from metagcttt.qos import COMMAND, EVENTS, keep_several, LATCHED, RECORDED_DEPTH

STATUS_PERIOD_S = 0.2


class PolicyPublishers:
    """Publishes `action`, `adaptation` and `policy_status` while the node is active."""

    def __init__(self, node: LifecycleNode, instance: int) -> None:
        """Connect.

        Args:
            node: The node to publish through.
            instance: Number that tells this policy from others in the graph.
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
        """Disconnect."""
        for publisher in (self._actions, self._reports, self._statuses):
            self._node.destroy_lifecycle_publisher(publisher)

    def action(self, state: State, command: Command) -> None:
        """The answer to a state."""
        self._actions.publish(
            action_message(
                self._node.get_clock().now().to_msg(),
                episode_id=state.episode_id,
                step=state.step,
                query_id=command.query_id,
                values=command.values,
                adapted=command.adapted,
                instance=self._instance,
            )
        )

    def report(
        self,
        query_id: int,
        episode_id: int,
        outcome: Outcome | None = None,
        reason: str = '',
        *,
        cached: bool = False,
    ) -> None:
        """What became of an adaptation."""
        report = report_message(
            self._node.get_clock().now().to_msg(),
            query_id=query_id,
            episode_id=episode_id,
            support=outcome.support if outcome else None,
            adaptation=outcome.adaptation if outcome else None,
            reason=reason,
            cached=cached,
        )
        self._reports.publish(report)
        verdict = f'adapted in {report.adapt_ms:.0f} ms' if report.accepted else 'not adapted'
        verdict = 'adapted before' if cached else verdict
        self._node.get_logger().info(
            f'goal {query_id}: {report.transitions} transitions of {report.kept_trajectories} of '
            f'{report.relevant_trajectories} trajectories in {report.filter_ms:.1f} ms; {verdict}'
            f'{": " if report.reason else ""}{report.reason}'
        )

    def status(self, query: Query | None, state: State | None) -> None:
        """What the policy is doing, when that is new or was last said a while ago."""
        status = PolicyStatus(instance=self._instance)
        if query is not None:
            status.query_id = query.query_id
            status.episode_id = query.episode_id
            status.steps_done = query.steps_done
            status.steps = query.config.steps
            status.adapted = query.adapted
            if query.adapting:
                status.phase = PolicyStatus.ADAPTING
            elif state is not None and query.serves(state):
                status.phase = PolicyStatus.ACTING
            else:
                status.phase = PolicyStatus.WAITING
        now_s = time.monotonic()
        unchanged = status == self._last_status
        if unchanged and now_s - self._last_status_s < STATUS_PERIOD_S:
            return
        self._last_status, self._last_status_s = status, now_s
        header = Header(stamp=self._node.get_clock().now().to_msg())
        fields = {name: getattr(status, name) for name in status.get_fields_and_field_types()}
        self._statuses.publish(PolicyStatus(**{**fields, 'header': header}))
