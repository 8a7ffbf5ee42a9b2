"""Publishers of the policy node, and the messages they send."""

import time

from metagcttt_core import Adaptation
from metagcttt_interfaces.msg import ActionCommand, AdaptationReport, PolicyStatus
from rclpy.lifecycle import LifecycleNode
from std_msgs.msg import Header

from metagcttt.adaptation_messages import report_message
from metagcttt.converters import action_message
from metagcttt.goal_in_force import Goal
from metagcttt.policy.decision import Command, Pursuit, State
from metagcttt.qos import COMMAND, EVENTS, keep_several, LATCHED, RECORDED_DEPTH

STATUS_PERIOD_S = 0.2


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

    def publish_report(
        self, goal: Goal, adaptation: Adaptation, *, cached: bool = False, remark: str = ''
    ) -> None:
        """Publish and log the result of an adaptation; see `report_message`."""
        report = report_message(
            self._node.get_clock().now().to_msg(), goal, adaptation, cached=cached, remark=remark
        )
        self._reports.publish(report)
        verdict = f'adapted in {report.adapt_ms:.0f} ms' if report.accepted else 'not adapted'
        verdict = 'adapted before' if cached else verdict
        verdict += f' by {report.adapter}' if report.adapter else ''
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
