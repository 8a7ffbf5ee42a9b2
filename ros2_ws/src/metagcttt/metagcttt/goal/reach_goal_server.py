"""The `reach_goal` action: one goal of it at a time is under way."""

from collections.abc import Callable
import time

from metagcttt_interfaces.action import ReachGoal
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from metagcttt.goal.goals import Verdict

FEEDBACK_PERIOD_S = 0.1


class _DeferredActionServer(ActionServer):
    """An action server whose results are given when they are known.

    The execute callback that rclpy asks for would occupy a thread, or, as a coroutine, wake the
    executor all the time, until the robot has arrived.
    """

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable | None
    ) -> None:
        """A goal begins; nothing to compute."""

    def give_result(self, goal_handle: ServerGoalHandle, result: ReachGoal.Result) -> None:
        """Send the result of a goal that was marked as ended."""
        super().notify_execute(goal_handle, lambda _: result)


class ReachGoalServer:
    """Speaks the protocol of the action; what becomes of goals is decided by its owner."""

    def __init__(
        self,
        node: Node,
        *,
        is_acceptable: Callable[[ReachGoal.Goal], bool],
        begin: Callable[[ReachGoal.Goal], None],
        cancel: Callable[[], None],
    ) -> None:
        """Offer the action.

        Args:
            node: The node to offer it through.
            is_acceptable: Whether a request is taken; says why if not.
            begin: Takes up a request that was acceptable, after calling `finish` for what it
                replaces.
            cancel: Ends the goal under way, calling `finish`.
        """
        self._node = node
        self._is_acceptable = is_acceptable
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
            goal_callback=self._on_request,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )

    def report(self, feedback: ReachGoal.Feedback) -> None:
        """Tell the sender how far the goal is, at once when the phase changes."""
        now_s = time.monotonic()
        due = now_s - self._last_feedback_s >= FEEDBACK_PERIOD_S
        if self._handle is not None and (due or feedback.phase != self._last_feedback.phase):
            self._last_feedback, self._last_feedback_s = feedback, now_s
            self._handle.publish_feedback(feedback)

    def finish(self, verdict: Verdict, steps: int, seconds: float) -> None:
        """Send the result of the goal under way, if it is one of this action."""
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
            steps=steps,
            seconds=seconds,
            error_code=getattr(ReachGoal.Result, verdict.error),
            error_msg='' if verdict.error == 'NONE' else verdict.reason,
        )
        self._server.give_result(handle, result)

    def destroy(self) -> None:
        """Withdraw the action."""
        self._server.destroy()

    def _on_request(self, request: ReachGoal.Goal) -> GoalResponse:
        return GoalResponse.ACCEPT if self._is_acceptable(request) else GoalResponse.REJECT

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        self._begin(handle.request)
        self._handle = handle
        handle.execute()

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        # rclpy marks the goal as being canceled after this returns.
        executor = self._node.executor
        assert executor is not None, 'it calls this'
        executor.create_task(self._finish_cancel, handle)
        return CancelResponse.ACCEPT

    def _finish_cancel(self, handle: ServerGoalHandle) -> None:
        if self._handle is not None and self._handle == handle:
            self._cancel()
