"""Server of the `reach_goal` action, with one goal under way at a time."""

from collections.abc import Callable
import math
import time

from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import PolicyStatus
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from metagcttt.goal.goals import AcceptedGoal, RobotState
from metagcttt.goal.tracker import Ended
from metagcttt.goal.verdict import Verdict

FEEDBACK_PERIOD_S = 0.1


def feedback_message(
    goal: AcceptedGoal, state: RobotState | None, policy: PolicyStatus
) -> ReachGoal.Feedback:
    """The progress towards a goal, by the newest state and the policy's newest status.

    Args:
        goal: The goal in force.
        state: The newest state of its episode; None before the first, when the distance is NaN.
        policy: What the policy last reported, perhaps on another goal.
    """
    feedback = ReachGoal.Feedback(phase=ReachGoal.Feedback.WAITING, distance_m=math.nan)
    if state is not None:
        feedback.distance_m = math.dist(state.xy, goal.xy)  # NaN for a robot without a position
        feedback.steps = max(state.step - goal.first_step, 0)
    if policy.query_id == goal.query_id:
        feedback.phase = {
            PolicyStatus.ADAPTING: ReachGoal.Feedback.ADAPTING,
            PolicyStatus.ACTING: ReachGoal.Feedback.DRIVING,
        }.get(policy.phase, ReachGoal.Feedback.WAITING)
        feedback.adapt_steps_done = policy.steps_done
        feedback.adapt_steps = policy.steps
        feedback.adapted = policy.adapted
    return feedback


class _DeferredActionServer(ActionServer):
    """An action server that sends results when they are known, without an execute callback.

    Until the robot has arrived, the callback that rclpy asks for would occupy a thread or, as a
    coroutine, keep waking the executor.
    """

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable | None
    ) -> None:
        """Ignore the start of a goal, which needs no computation."""

    def give_result(self, goal_handle: ServerGoalHandle, result: ReachGoal.Result) -> None:
        """Send the result of a goal whose final state is set."""
        super().notify_execute(goal_handle, lambda _: result)


class ReachGoalServer:
    """Implements the protocol of the action; its owner decides about goals."""

    def __init__(
        self,
        node: Node,
        *,
        refusal: Callable[[ReachGoal.Goal], Verdict | None],
        begin: Callable[[ReachGoal.Goal], None],
        cancel: Callable[[], None],
    ) -> None:
        """Create the action server.

        Args:
            node: The node that owns it.
            refusal: The reason why a request is refused, which it publishes; None when it is not.
            begin: Puts an acceptable request in force, after `finish` for the goal it replaces.
            cancel: Ends the goal under way, with `finish`.
        """
        self._node = node
        self._refusal = refusal
        self._begin = begin
        self._cancel = cancel
        self._handle: ServerGoalHandle | None = None
        self._last_feedback = ReachGoal.Feedback()
        self._last_feedback_s = -FEEDBACK_PERIOD_S
        self._server = _DeferredActionServer(
            node,
            ReachGoal,
            'reach_goal',
            execute_callback=ReachGoal.Result,  # never called
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )

    def report(self, feedback: ReachGoal.Feedback) -> None:
        """Send feedback, at its own rate and whenever the phase changes."""
        now_s = time.monotonic()
        due = now_s - self._last_feedback_s >= FEEDBACK_PERIOD_S
        if self._handle is not None and (due or feedback.phase != self._last_feedback.phase):
            self._last_feedback, self._last_feedback_s = feedback, now_s
            self._handle.publish_feedback(feedback)

    def finish(self, ended: Ended) -> None:
        """Send the result of the goal under way, if it is one of this action."""
        verdict = ended.verdict
        handle, self._handle = self._handle, None
        if handle is None:
            return
        if verdict.error == 'NONE':
            handle.succeed()
        elif verdict.error == 'CANCELED' and handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        result = ReachGoal.Result(
            success=verdict.error == 'NONE',
            steps=ended.step - ended.goal.first_step,
            seconds=ended.seconds,
            error_code=getattr(ReachGoal.Result, verdict.error),
            error_msg='' if verdict.error == 'NONE' else verdict.reason,
        )
        self._server.give_result(handle, result)

    def destroy(self) -> None:
        """Destroy the action server."""
        self._server.destroy()

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        # Rejected by the protocol, a goal has no result, and its sender would not learn why.
        refusal = self._refusal(handle.request)
        if refusal is not None:
            handle.execute()
            handle.abort()
            code = getattr(ReachGoal.Result, refusal.error)
            result = ReachGoal.Result(error_code=code, error_msg=refusal.reason)
            self._server.give_result(handle, result)
            return
        self._begin(handle.request)
        self._handle = handle
        handle.execute()

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        # rclpy marks the goal as being canceled after this returns.
        executor = self._node.executor
        assert executor is not None, 'the caller'
        executor.create_task(self._finish_cancel, handle)
        return CancelResponse.ACCEPT

    def _finish_cancel(self, handle: ServerGoalHandle) -> None:
        if self._handle is not None and self._handle == handle:
            self._cancel()
