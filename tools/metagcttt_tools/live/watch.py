"""A running graph as the live view knows it: newest messages, and requests to its nodes."""

from functools import partial
from pathlib import Path
import time
from typing import Any

from action_msgs.srv import CancelGoal
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from metagcttt.commander import RobotCommander
from metagcttt.qos import EVENTS, LATCHED, SENSOR
from metagcttt_interfaces.msg import (
    AdaptationReport,
    EpisodeEvent,
    GoalQuery,
    MazeState,
    PolicyStatus,
)
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python

from metagcttt_tools.live.robots import contracted, Robot, simulated
from metagcttt_tools.live.words import health_of, news_of, WAITING

_POLICY_SETTINGS = (
    *('checkpoint', 'dataset', 'adapt_steps', 'adapt_lr', 'adapt_batch_size'),
    *('early_stopping', 'test_fraction', 'guard', 'actor_only', 'optimizer_state'),
)
_ANSWER_S = 5.0
_CONFIGURED_S = 60.0  # policy and dataset are loaded


class RefusedError(RuntimeError):
    """A node refused a request; the message has its reason."""


class Watch(RobotCommander):
    """Joins the graph of one robot, whose nodes may come and go.

    Attributes:
        grid: The maze; None until there is a simulator.
        state: The newest state, if there was one.
        goal: The newest goal, in force or over.
        report: The newest adaptation.
        status: What the policy is doing.
        news: The newest event, in words.
        policy: Parameters of the policy node; empty until it answers.
        robot: By the environment of the goal node or the contract of the robot bridge; None until
            one of them answers.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Subscribe to what the view shows.

        Args:
            kwargs: For `RobotCommander`, such as the `namespace` of the robot.
        """
        super().__init__(name='live_view', **kwargs)
        self.grid: OccupancyGrid | None = None
        self.state: MazeState | None = None
        self.goal: GoalQuery | None = None
        self.report: AdaptationReport | None = None
        self.status = PolicyStatus()
        self.news = WAITING
        self.policy: dict[str, Any] = {}
        self.robot: Robot | None = None
        self._health: dict[str, tuple[DiagnosticStatus, float]] = {}
        for message_type, topic, attribute, profile in (
            (MazeState, 'state', 'state', SENSOR),
            (GoalQuery, 'goal', 'goal', LATCHED),
            (AdaptationReport, 'adaptation', 'report', EVENTS),
            (PolicyStatus, 'policy_status', 'status', LATCHED),
        ):
            self.create_subscription(
                message_type, topic, partial(setattr, self, attribute), profile
            )
        self.create_subscription(OccupancyGrid, 'map', self._on_map, LATCHED)
        self.create_subscription(EpisodeEvent, 'episode', self._on_news, EVENTS)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._cancel = self.create_client(CancelGoal, 'reach_goal/_action/cancel_goal')
        self._change_state = self.create_client(ChangeState, 'policy_node/change_state')
        self._set_policy = self.create_client(SetParameters, 'policy_node/set_parameters')
        self._of_policy = self.create_client(GetParameters, 'policy_node/get_parameters')
        self._of_goal_node = self.create_client(GetParameters, 'goal_node/get_parameters')
        self._of_bridge = self.create_client(GetParameters, 'robot_bridge_node/get_parameters')

    def _on_map(self, message: OccupancyGrid) -> None:
        self.grid = message
        self._frame_id = message.header.frame_id

    def _on_news(self, message: EpisodeEvent) -> None:
        self.news = news_of(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.rpartition('/')[0] == self.get_namespace().rstrip('/'):
                self._health[status.name] = status, time.monotonic()

    def health(self) -> list[tuple[str, int, str]]:
        """Name, level and message of every node that was heard of; a silent one is in error."""
        return health_of(self._health, time.monotonic())

    def spin(self, timeout_s: float) -> None:
        """Handle a message, waiting for it at most so long."""
        self._spun.spin_once(timeout_sec=timeout_s)

    # --- requests ----------------------------------------------------------------------------

    def read_settings(self) -> None:
        """Read the parameters of the nodes that are there.

        Raises:
            NoAnswerError: If one of them does not answer.
            ContractError: If the contract of the robot is not readable here.
        """
        if self._of_policy.service_is_ready():
            request = GetParameters.Request(names=_POLICY_SETTINGS)
            values = self._call(self._of_policy, request, _ANSWER_S).values
            found = [parameter_value_to_python(value) for value in values]
            self.policy = dict(zip(_POLICY_SETTINGS, found, strict=True))
        if self._of_goal_node.service_is_ready():
            request = GetParameters.Request(names=['environment', 'goal_tolerance_m'])
            name, tolerance = self._call(self._of_goal_node, request, _ANSWER_S).values
            self.robot = simulated(name.string_value, tolerance.double_value)
        if self._of_bridge.service_is_ready():
            request = GetParameters.Request(names=['contract'])
            (contract,) = self._call(self._of_bridge, request, _ANSWER_S).values
            self.robot = contracted(Path(contract.string_value).expanduser())

    def cancel_goals(self) -> None:
        """Cancel the action goal under way, whoever sent it.

        Raises:
            NoAnswerError: If there is no answer.
            RefusedError: If there is none; a goal of `goal_pose` or of a task is not one.
        """
        answer = self._call(self._cancel, CancelGoal.Request(), _ANSWER_S)
        if not answer.goals_canceling:
            raise RefusedError('no goal of the reach_goal action is under way')

    def set_policy(self, **values: bool | int | float | str) -> None:
        """Set parameters of the policy node.

        Raises:
            NoAnswerError: If there is no answer.
            RefusedError: If one is refused.
        """
        parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        request = SetParameters.Request(parameters=parameters)
        for result in self._call(self._set_policy, request, _ANSWER_S).results:
            if not result.successful:
                raise RefusedError(result.reason)

    def change_checkpoint(self, checkpoint: str) -> None:
        """Take the policy node through its lifecycle to another checkpoint.

        Raises:
            NoAnswerError: If there is no answer.
            RefusedError: If the node does not accept it; it then stays unconfigured.
        """
        self._transit(Transition.TRANSITION_DEACTIVATE)
        self._transit(Transition.TRANSITION_CLEANUP)
        self.set_policy(checkpoint=checkpoint)
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            if not self._transit(transition):
                raise RefusedError(f'the policy node cannot be configured with {checkpoint}')

    def _transit(self, transition: int) -> bool:
        """Ask for a transition; false when the node is in no state for it, or it failed."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self._call(self._change_state, request, _CONFIGURED_S).success)
