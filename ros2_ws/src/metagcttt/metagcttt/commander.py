"""Client for programs: drives a robot with blocking or non-blocking calls."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
import math
import time
from typing import Any
import uuid

from geometry_msgs.msg import PoseStamped
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent
from metagcttt_interfaces.srv import SetTask
from numpy.typing import ArrayLike
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.client import Client
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from metagcttt.converters import to_floats, to_point
from metagcttt.qos import EVENTS

SILENT_S = 3.0  # the goal node sends feedback ten times a second


class NoAnswerError(RuntimeError):
    """The graph did not answer in time."""


class GoalLostError(NoAnswerError):
    """The goal node is silent, and its goal is lost."""


@dataclass(frozen=True)
class ReachResult:
    """Result of a goal.

    Attributes:
        success: Whether the robot is within the goal tolerance.
        steps: Control steps it took.
        seconds: Time it took, by the goal node's clock.
        error_code: One of the constants of `ReachGoal.Result`; 0 on success.
        error_msg: The error in words.
    """

    success: bool
    steps: int = 0
    seconds: float = 0.0
    error_code: int = ReachGoal.Result.NONE
    error_msg: str = ''


class RobotCommander(Node):
    """Sends goals and tasks to one robot.

    Waiting calls spin the node, so no thread or executor is needed. To go on meanwhile, call
    `send`, poll `is_done` and take the `result` at the end.

    Example::

        commander = RobotCommander()
        result = commander.reach((20.0, 20.0))
        print(result.success or result.error_msg)
    """

    def __init__(
        self,
        *,
        name: str = 'robot_commander',
        frame_id: str = 'map',
        executor: Executor | None = None,
        while_waiting: Callable[[], None] = lambda: None,
        **kwargs: Any,
    ) -> None:
        """Create the node.

        Args:
            name: Name of the node.
            frame_id: Frame of positions.
            executor: Executor to spin while waiting; its own by default.
            while_waiting: Called repeatedly while waiting; its exceptions propagate.
            kwargs: For `rclpy.node.Node`, such as the `namespace` of the robot.
        """
        super().__init__(name, **kwargs)
        self._frame_id = frame_id
        self._while_waiting = while_waiting
        self._spun = executor or SingleThreadedExecutor(context=self.context)
        self._spun.add_node(self)
        self._reach_goal = ActionClient(self, ReachGoal, 'reach_goal')
        self._set_task = self.create_client(SetTask, 'set_task')
        self._reset = self.create_client(Trigger, 'reset')
        self._enable = self.create_client(SetBool, 'enable')
        # Started by this commander; the goal node may not know it yet.
        self._episode_id = self._world_id = 0
        self._verdicts: dict[str, EpisodeEvent | None] = {}  # to goals being sent
        self._verdicts_from = self.create_subscription(
            EpisodeEvent, 'episode', self._on_event, EVENTS
        )

    # --- goals -------------------------------------------------------------------------------

    def reach(
        self,
        goal: ArrayLike | Mapping[str, float],
        *,
        max_steps: int = 0,
        timeout_s: float = 60.0,
        **how: Any,
    ) -> ReachResult:
        """Drive to a goal and wait for the result.

        Args:
            goal: See `send`.
            max_steps: See `send`.
            timeout_s: Longest wait, seconds, after which the goal is canceled.
            how: `yaw`, `tolerances` and `max_s` of `send`.

        Raises:
            NoAnswerError: If it takes longer.
            GoalLostError: If the goal node becomes silent.
        """
        sent = self.send(goal, max_steps=max_steps, timeout_s=timeout_s, **how)
        try:
            return sent.result(timeout_s)
        except GoalLostError:
            raise
        except NoAnswerError:
            sent.cancel()
            raise

    def send(
        self,
        goal: ArrayLike | Mapping[str, float],
        *,
        yaw: float = 0.0,
        tolerances: Mapping[str, float] | None = None,
        max_steps: int = 0,
        max_s: float = 0.0,
        timeout_s: float = 10.0,
    ) -> 'SentGoal':
        """Send a goal and return when the goal node has accepted or rejected it.

        Args:
            goal: Position (x, y) in metres, a full goal observation, shape (obs_dim,), or values
                of a robot by the names of its contract, such as `{'elbow_joint.position': 1.2}`.
            yaw: With a position: orientation, rad; it counts where the contract says so.
            tolerances: With named values: largest deviation of each; by default the contract's.
            max_steps: Control steps that it may take; 0 for the goal node's own limit.
            max_s: Seconds that it may take; 0 for the contract's limit.
            timeout_s: Longest wait for the answer, seconds.

        Raises:
            NoAnswerError: If there is no answer.
        """
        request = ReachGoal.Goal(
            max_steps=max_steps,
            timeout_s=float(max_s),
            episode_id=self._episode_id,
            world_id=self._world_id,
            request_id=uuid.uuid4().hex,
        )
        request.pose = PoseStamped()
        request.pose.header.frame_id = self._frame_id
        request.pose.pose.orientation.z = math.sin(yaw / 2)
        request.pose.pose.orientation.w = math.cos(yaw / 2)
        if isinstance(goal, Mapping):
            request.named.names = list(goal)
            request.named.values = to_floats(list(goal.values()))
            if tolerances is not None:
                request.named.tolerances = to_floats([tolerances[name] for name in goal])
        elif len(values := to_floats(goal)) == 2:
            request.pose.pose.position = to_point(values)
        else:
            request.goal = values
        return self.send_request(request, timeout_s)

    def send_request(self, request: ReachGoal.Goal, timeout_s: float = 10.0) -> 'SentGoal':
        """Send an action goal unchanged; its `request_id` must be unique."""
        self.wait(self._reach_goal.server_is_ready, 'action reach_goal', timeout_s)
        self.wait(
            lambda: self._verdicts_from.get_publisher_count() > 0, 'topic episode', timeout_s
        )
        sent = SentGoal(self)
        self._verdicts[request.request_id] = None
        future = self._reach_goal.send_goal_async(request, feedback_callback=sent.on_feedback)
        try:
            self.wait(future.done, 'the answer to a goal', timeout_s)
            answer = partial(self._verdicts.get, request.request_id)
            self.wait(answer, 'whether a goal was accepted', timeout_s)
        finally:
            event = self._verdicts.pop(request.request_id)
        assert event is not None, 'waited for'
        if event.kind == EpisodeEvent.GOAL_ACCEPTED:
            sent.begin(future.result())
        else:
            sent.refuse(ReachResult(False, error_code=event.error_code, error_msg=event.reason))
        return sent

    def _on_event(self, message: EpisodeEvent) -> None:
        episode = (self._world_id, self._episode_id)
        if message.kind == EpisodeEvent.STARTED and (
            (message.world_id, message.episode_id) != episode
        ):
            self._episode_id = self._world_id = 0  # started by another node
        is_answer = message.kind in (EpisodeEvent.GOAL_ACCEPTED, EpisodeEvent.GOAL_REJECTED)
        if is_answer and message.request_id in self._verdicts:
            self._verdicts[message.request_id] = message

    # --- services ----------------------------------------------------------------------------

    def set_task(
        self, task_id: int, seed: int = 0, *, send_goal: bool = False, timeout_s: float = 10.0
    ) -> SetTask.Response:
        """Reset the robot to the start of an evaluation task; see SetTask for the response."""
        request = SetTask.Request(task_id=task_id, seed=seed, send_goal=send_goal)
        response = self._call(self._set_task, request, timeout_s)
        if response.success:
            self._episode_id, self._world_id = response.episode_id, response.world_id
        return response

    def reset(self, timeout_s: float = 10.0) -> Trigger.Response:
        """Start an episode without a task, at a random position."""
        self._episode_id = self._world_id = 0
        return self._call(self._reset, Trigger.Request(), timeout_s)

    def enable(self, enabled: bool, timeout_s: float = 10.0) -> SetBool.Response:
        """Allow the robot to move, or make every action zero."""
        return self._call(self._enable, SetBool.Request(data=enabled), timeout_s)

    def _call(self, client: Client, request: Any, timeout_s: float) -> Any:
        self.wait(client.service_is_ready, f'service {client.srv_name}', timeout_s)
        future = client.call_async(request)
        try:
            self.wait(future.done, f'the answer of {client.srv_name}', timeout_s)
        except NoAnswerError:
            client.remove_pending_request(future)
            raise
        return future.result()

    # --- waiting -----------------------------------------------------------------------------

    def wait(self, condition: Callable[[], Any], what: str, timeout_s: float) -> None:
        """Spin until `condition` holds.

        Raises:
            NoAnswerError: If it does not hold within `timeout_s`; the message names `what`.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            self._while_waiting()
            if time.monotonic() > deadline:
                raise NoAnswerError(f'no answer within {timeout_s:g} s: {what}')
            self._spun.spin_once(timeout_sec=0.05)

    def take_in(self) -> None:
        """Handle one message that has already arrived."""
        self._spun.spin_once(timeout_sec=0)

    def destroy_node(self) -> None:
        """Destroy the node."""
        self._spun.remove_node(self)
        self._reach_goal.destroy()
        super().destroy_node()


class SentGoal:
    """A goal that was sent by `RobotCommander.send`.

    Attributes:
        feedback: The newest feedback; None before the first.
    """

    def __init__(self, commander: RobotCommander) -> None:
        """Create a goal without an answer."""
        self.feedback: ReachGoal.Feedback | None = None
        self._commander = commander
        self._heard_s = self._looked_s = float('-inf')
        self._handle: ClientGoalHandle | None = None
        self._answer: Future | None = None
        self._result: ReachResult | None = None

    @property
    def accepted(self) -> bool:
        """True when the goal node accepted it."""
        return self._handle is not None

    def is_done(self) -> bool:
        """True when the result is known; handles waiting messages first.

        Raises:
            GoalLostError: If the goal node has become silent.
        """
        if self._result is None:
            self._commander.take_in()
        return self._is_known()

    def result(self, timeout_s: float = 60.0) -> ReachResult:
        """Wait for the result.

        Raises:
            NoAnswerError: If there is none within `timeout_s`.
            GoalLostError: If the goal node becomes silent.
        """
        self._commander.wait(self._is_known, 'the goal', timeout_s)
        assert self._result is not None
        return self._result

    def cancel(self, timeout_s: float = 10.0) -> bool:
        """Cancel the goal; true if it was still under way. `result` says how it ended."""
        if self._handle is None or self._result is not None:
            return False
        future = self._handle.cancel_goal_async()
        self._commander.wait(future.done, 'the cancellation', timeout_s)
        return bool(future.result().goals_canceling)

    def on_feedback(self, message: Any) -> None:
        """Record a feedback message."""
        self.feedback = message.feedback
        self._heard_s = time.monotonic()

    def begin(self, handle: ClientGoalHandle) -> None:
        """Record that the goal was accepted."""
        self._handle = handle
        self._answer = handle.get_result_async()
        self._answer.add_done_callback(self._on_result)

    def refuse(self, result: ReachResult) -> None:
        """Record that the goal was rejected."""
        self._result = result

    def _is_known(self) -> bool:
        """True when the result is known; raises when the goal node is silent."""
        now_s = time.monotonic()
        if now_s - self._looked_s > SILENT_S / 2:
            self._heard_s = now_s  # nothing was spun meanwhile
        self._looked_s = now_s
        if self._result is None and now_s - self._heard_s > SILENT_S:
            raise GoalLostError(
                f'no feedback for {SILENT_S:g} s: the goal node is gone, and the goal with it'
            )
        return self._result is not None

    def _on_result(self, future: Future) -> None:
        result = future.result().result
        self._result = ReachResult(
            result.success, result.steps, result.seconds, result.error_code, result.error_msg
        )
