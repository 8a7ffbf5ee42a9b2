"""The adapter node: one dataset, one base policy and many robots that ask for experts."""

from dataclasses import dataclass
import time
from typing import Any

from metagcttt_core import TTTConfig
from metagcttt_core.config import error_lines
from metagcttt_interfaces.msg import Expert
from metagcttt_interfaces.srv import Adapt
from pydantic import ValidationError
from rclpy.exceptions import InvalidTopicNameException
from rclpy.publisher import Publisher
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.validate_full_topic_name import validate_full_topic_name
import torch

from metagcttt.adaptation_messages import expert_message
from metagcttt.adapter.health import AdapterMonitor
from metagcttt.adapter.requests import Ended, Ending, Request, RequestQueue
from metagcttt.conventions import ConventionalNode
from metagcttt.converters import to_array, to_goal
from metagcttt.deployment import adapt_to_goal, deployment_of, warm_up
from metagcttt.diagnostics import Diagnostics
from metagcttt.health import Health
from metagcttt.input_checks import vector_fault
from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import ADAPTER_NODE
from metagcttt.qos import LATCHED

LONGEST_S = 3600.0
LONGEST_REASON = 2000  # characters
PLACE_KEPT_S = 60.0
WARNING_PERIOD_S = 1.0
_ERRORS = {
    getattr(Adapt.Response, name): name
    for name in ('FULL', 'OTHER_CHECKPOINT', 'OTHER_DATASET', 'OTHER_FILTER', 'MALFORMED')
} | {Adapt.Response.UNKNOWN: 'UNKNOWN', Adapt.Response.ENDING: 'ENDING'}


class _Refusal(Exception):
    """A request is refused; says why."""

    def __init__(self, error_code: int, message: str) -> None:
        super().__init__(message)
        self.error_code = error_code


@dataclass
class _Robot:
    """A robot that is served.

    Attributes:
        experts: Where its experts go.
        seen_s: When it last asked, seconds of a monotonic clock.
        served: Its newest request that was done.
    """

    experts: Publisher
    seen_s: float
    served: Request | None = None


class AdapterNode(ConventionalNode):
    """Answers `adapt` at once, and sends the experts to the robots that asked."""

    def __init__(self, **kwargs: Any) -> None:
        """Load policy and dataset, and serve.

        Args:
            kwargs: For `rclpy.node.Node`.

        Raises:
            OSError, ValueError: If policy or dataset cannot be used.
        """
        super().__init__('adapter_node', **kwargs)
        self._settings = ParameterSet(self, ADAPTER_NODE, is_configured=lambda: True)
        self._deployment = deployment_of(self._settings)
        self._identity = self._deployment.identity
        if self._settings['threads']:
            torch.set_num_threads(self._settings['threads'])
        engine = warm_up(self._deployment, TTTConfig(batch_size=256))
        self._monitor = AdapterMonitor(engine)
        self._robots: dict[str, _Robot] = {}
        self._is_ending = False
        self._ended = self.create_guard_condition(self._on_ended)
        self._queue: RequestQueue[Expert] = RequestQueue(
            self._ended.trigger,
            workers=self._settings['workers'],
            size=self._settings['queue'],
            num_threads=self._settings['threads'],
        )
        self._service = self.create_service(Adapt, 'adapt', self._on_request)
        self._diagnostics = Diagnostics(
            self, self._examine, self._settings['diagnostics_period_s']
        )
        dataset = self._deployment.dataset
        self.get_logger().info(
            f'serves {self._service.service_name} with {self._settings["workers"]} workers: '
            f'{self._deployment.agent.name} policy {self._identity.checkpoint}, '
            f'{dataset.num_transitions} transitions {self._identity.dataset}, engine {engine}'
        )

    def end_service(self) -> None:
        """Refuse requests from now on, end those under way and tell their robots."""
        self._is_ending = True
        self._queue.close()
        self._on_ended()

    def destroy_node(self) -> None:
        """End the threads, then destroy the node."""
        self._is_ending = True
        self._queue.close()
        super().destroy_node()

    # --- requests ----------------------------------------------------------------------------

    def _on_request(self, request: Adapt.Request, response: Adapt.Response) -> Adapt.Response:
        try:
            if request.cancel:
                self._cancel(request)
            else:
                self._accept(request)
            response.success = True
        except _Refusal as refusal:
            response.error_code, response.message = (
                refusal.error_code,
                str(refusal)[:LONGEST_REASON],
            )
            if not request.cancel:
                name = _ERRORS[refusal.error_code]
                self._monitor.refused(name, f'{name}, {refusal}')
                self.get_logger().warning(
                    f'refused {request.robot[:100]!r}: {refusal}',
                    throttle_duration_sec=WARNING_PERIOD_S,
                )
        response.waiting = self._queue.num_waiting
        return response

    def _cancel(self, request: Adapt.Request) -> None:
        if not self._queue.cancel(_asked(request)):
            raise _Refusal(Adapt.Response.UNKNOWN, 'there is no such request')

    def _accept(self, request: Adapt.Request) -> None:
        if self._is_ending:
            raise _Refusal(Adapt.Response.ENDING, 'the adapter is about to end')
        self._check_identity(request)
        config = self._config_of(request)
        observation, goal = to_array(request.observation), to_goal(request.query)
        self._on_ended()  # so that what is done is known
        robot, asked = self._robot(request.robot), _asked(request)
        robot.seen_s = time.monotonic()
        if robot.served == asked or self._queue.has(asked):
            return  # a repetition
        deployment = self._deployment

        def job(should_stop: Any) -> Expert:
            adaptation = adapt_to_goal(deployment, observation, goal, config, should_stop)
            return expert_message(deployment.agent, goal, adaptation)

        if full := self._queue.submit(asked, job, request.timeout_s):
            raise _Refusal(Adapt.Response.FULL, full)
        self._monitor.accepted()

    def _check_identity(self, request: Adapt.Request) -> None:
        for name, error_code in (
            ('checkpoint', Adapt.Response.OTHER_CHECKPOINT),
            ('dataset', Adapt.Response.OTHER_DATASET),
            ('filter', Adapt.Response.OTHER_FILTER),
        ):
            own, other = getattr(self._identity, name), getattr(request, name)
            if own != other:
                raise _Refusal(
                    error_code,
                    f'another {name}: the adapter has {own}, the robot {other!r}',
                )

    def _config_of(self, request: Adapt.Request) -> TTTConfig:
        """The inner loop of a request whose other fields are right as well.

        Raises:
            _Refusal: Names what is false.
        """
        obs_dim = self._deployment.agent.obs_dim
        fault = vector_fault('the state', to_array(request.observation), obs_dim) or vector_fault(
            'the goal', to_array(request.query.goal), obs_dim
        )
        if not 0 < request.timeout_s <= LONGEST_S:
            fault = f'timeout_s must be above 0 and at most {LONGEST_S:g}, got {request.timeout_s}'
        if not fault:
            try:
                config = TTTConfig.model_validate_json(request.settings)
                self._deployment.check_optimizer_state(config.optimizer_state)
            except ValidationError as error:
                fault = '; '.join(error_lines(error))
            except ValueError as error:
                fault = str(error)
        if not fault:
            for name, value, largest in (
                ('steps', config.steps, self._settings['max_steps']),
                ('batch_size', config.batch_size, self._settings['max_batch_size']),
            ):
                if not 1 <= value <= largest:
                    fault = f'{name} must be 1 to {largest} for this adapter, got {value}'
        if fault:
            raise _Refusal(Adapt.Response.MALFORMED, fault)
        return config

    # --- robots ------------------------------------------------------------------------------

    def _robot(self, name: str) -> _Robot:
        """The robot of that name, which is served from now on.

        Raises:
            _Refusal: If that is no name of a node, or too many are served.
        """
        if name in self._robots:
            return self._robots[name]
        topic = f'{name}/expert'
        try:
            if not name:
                raise InvalidTopicNameException(name, 'it is empty', 0)
            validate_full_topic_name(topic)
        except InvalidTopicNameException as error:
            reason = f'robot must be the full name of a node, got {name[:100]!r}'
            raise _Refusal(Adapt.Response.MALFORMED, reason) from error
        self._forget_robots()
        if len(self._robots) >= self._settings['robots']:
            reason = f'{len(self._robots)} robots are served already'
            raise _Refusal(Adapt.Response.FULL, reason)
        experts = self.create_publisher(
            # No parameters for each robot, as they would stay behind.
            Expert,
            topic,
            LATCHED,
            qos_overriding_options=QoSOverridingOptions([]),
        )
        self._robots[name] = _Robot(experts, time.monotonic())
        return self._robots[name]

    def _forget_robots(self) -> None:
        """Forget the robots that have been silent for a while and do not listen any more."""
        self._on_ended()
        busy, now_s = self._queue.robots(), time.monotonic()
        for name, robot in list(self._robots.items()):
            is_gone = now_s - robot.seen_s > PLACE_KEPT_S and name not in busy
            if is_gone and not robot.experts.get_subscription_count():
                self.destroy_publisher(robot.experts)
                del self._robots[name]

    def _on_ended(self) -> None:
        for ended in self._queue.take_ended():
            message = ended.result or Expert()
            self._monitor.ended(ended, message.report.adapt_ms)
            self._monitor.engine = message.engine or self._monitor.engine
            if ended.ending == Ending.FAILED:
                self.get_logger().error(f'{ended.request.robot}: {ended.reason}')
            self._send(ended, message)

    def _send(self, ended: Ended[Expert], message: Expert) -> None:
        message.header.stamp = self.get_clock().now().to_msg()
        message.report.header.stamp = message.header.stamp
        message.instance = ended.request.instance
        message.request_id = ended.request.request_id
        message.status, message.reason = int(ended.ending), ended.reason
        message.wait_ms = ended.wait_ms
        message.checkpoint = self._identity.checkpoint
        robot = self._robots[ended.request.robot]
        if ended.ending == Ending.DONE:
            robot.served = ended.request
        robot.experts.publish(message)

    def _examine(self) -> Health:
        self._forget_robots()
        return self._monitor.examine(
            waiting=self._queue.num_waiting,
            running=self._queue.num_running,
            workers=self._settings['workers'],
            size=self._settings['queue'],
            robots=len(self._robots),
        )


def _asked(request: Adapt.Request) -> Request:
    return Request(request.robot, request.instance, request.request_id)
