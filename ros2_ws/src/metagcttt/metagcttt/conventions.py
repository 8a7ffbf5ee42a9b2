"""What ROS 2's own tools, and who uses them, expect of every node."""

from collections.abc import Iterator
from contextlib import contextmanager
import copy
from functools import wraps
import math
import re
from typing import Any

from metagcttt_core.config.settings import nearest_name
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import (
    QoSPolicyKind,
    QoSProfile,
)
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions

from metagcttt.clocks import STEADY

OVERRIDDEN = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)
OF_ROS = ('/parameter_events', '/rosout')
TYPES_PERIOD_S = 1.0
_OVERRIDE_OF_TOPIC = re.compile(r'qos_overrides\.([^.]+)\.')
MAX_NAME = 255  # characters in the name of a frame


class ConventionalNode(Node):
    """A node that names what keeps it from hearing others, and takes what it gave.

    - `ros2 param load` of its own `ros2 param dump` works: a parameter may be set to the value it
      has, also when it is read-only.
    - A parameter given at the start that it does not have, such as a misspelt one, is named in a
      warning.
    - The quality of service of its topics can be changed at the start, by the parameters
      `qos_overrides.TOPIC.publisher.reliability` and their kin.
    - Where it and another node cannot hear one another, because of a quality of service or because
      a topic has two types, such as Twist and TwistStamped, a warning names both sides.
    - A message whose frame is no name, but megabytes, is ignored: it would be sent on many times.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Create the node; the arguments are those of `rclpy.node.Node`."""
        self._types: dict[str, str] = {}  # of our topics
        self._told: set[tuple[str, ...]] = set()
        super().__init__(*args, **kwargs)
        self.create_timer(TYPES_PERIOD_S, self._look_around, clock=STEADY)

    # --- parameters --------------------------------------------------------------------------

    def set_parameters(self, parameter_list: list[Parameter]) -> list[SetParametersResult]:
        """Set parameters one by one."""
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all parameters or none; those that have their value already are left alone."""
        for name in (parameter.name for parameter in parameter_list):
            if not self.has_parameter(name):
                reason = f'there is no parameter {name[:MAX_NAME]!r}{self._hint(name)}'
                return SetParametersResult(successful=False, reason=reason)
        asked = [self._as_declared(parameter) for parameter in parameter_list]
        changes = [parameter for parameter in asked if not self._has(parameter)]
        if not changes:
            return SetParametersResult(successful=True)
        return super().set_parameters_atomically(changes)

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, **kwargs: Any) -> Any:
        """Create a service; those that set parameters answer for each, whatever is asked."""
        ours = {
            SetParameters: self._answer_set_parameters,
            SetParametersAtomically: self._answer_set_parameters_atomically,
        }
        return super().create_service(srv_type, srv_name, ours.get(srv_type, callback), **kwargs)

    def _answer_set_parameters(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        response.results = [self._set_from_messages([each]) for each in request.parameters]
        return response

    def _answer_set_parameters_atomically(
        self, request: SetParametersAtomically.Request, response: SetParametersAtomically.Response
    ) -> SetParametersAtomically.Response:
        response.result = self._set_from_messages(request.parameters)
        return response

    def _set_from_messages(self, messages: list[ParameterMessage]) -> SetParametersResult:
        known = {kind.value for kind in Parameter.Type}
        for message in messages:
            if message.value.type not in known:
                reason = (
                    f'{message.name[:MAX_NAME]} has the type {message.value.type}, which there is '
                    f'not: 0 to {max(known)} are accepted'
                )
                return SetParametersResult(successful=False, reason=reason)
        return self.set_parameters_atomically(
            [Parameter.from_parameter_msg(message) for message in messages]
        )

    def _hint(self, name: str) -> str:
        """What may have been meant by the name of a parameter that there is not."""
        near = nearest_name(name[:MAX_NAME], self.get_parameters_by_prefix(''))
        return f'; did you mean {near}?' if near else ''

    def _as_declared(self, parameter: Parameter) -> Parameter:
        """A number as text becomes a number: the tools read 1e-05 so, and write it so."""
        is_text = parameter.type_ == Parameter.Type.STRING
        if is_text and self.has_parameter(parameter.name):
            declared = self.get_parameter(parameter.name).type_
            try:
                value = float(parameter.value)
            except ValueError:
                return parameter
            if declared == Parameter.Type.DOUBLE and math.isfinite(value):
                return Parameter(parameter.name, declared, value)
        return parameter

    def _has(self, parameter: Parameter) -> bool:
        if not self.has_parameter(parameter.name):
            return False
        own = self.get_parameter(parameter.name)
        return (own.type_, own.value) == (parameter.type_, parameter.value)

    def _name_unknown_parameters(self) -> None:
        own = self.get_parameters_by_prefix('')
        for name in sorted(self._parameter_overrides.keys() - own.keys()):
            topic = _OVERRIDE_OF_TOPIC.match(name)
            later = topic and topic[1] not in self._types  # it may be created yet
            if ('parameter', name) in self._told or later:
                continue
            self._told.add(('parameter', name))
            self.get_logger().warning(
                f'there is no parameter {name}, it is ignored{self._hint(name)}'
            )

    # --- topics ------------------------------------------------------------------------------

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **kwargs: Any) -> Any:
        """Create a publisher; see the class for what it has besides."""
        profile, kwargs = self._conventions(msg_type, topic, qos_profile, kwargs, True)
        with _override_errors(topic):
            return super().create_publisher(msg_type, topic, profile, **kwargs)

    def create_lifecycle_publisher(
        self, msg_type: Any, topic: str, qos_profile: Any, **kwargs: Any
    ) -> Any:
        """Create a publisher of a lifecycle node, likewise."""
        profile, kwargs = self._conventions(msg_type, topic, qos_profile, kwargs, True)
        with _override_errors(topic):
            return super().create_lifecycle_publisher(  # type: ignore[misc]
                msg_type, topic, profile, **kwargs
            )

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **kwargs: Any
    ) -> Any:
        """Create a subscription; see the class for what it has besides."""
        profile, kwargs = self._conventions(msg_type, topic, qos_profile, kwargs, False)
        with _override_errors(topic):
            subscription = super().create_subscription(
                msg_type, topic, self._bounded(topic, callback), profile, **kwargs
            )
        return subscription

    def _bounded(self, topic: str, callback: Any) -> Any:
        """The callback, for messages whose frame is a name: it is copied into what is sent."""

        @wraps(callback)
        def bounded(message: Any, *info: Any) -> Any:
            length = len(getattr(getattr(message, 'header', None), 'frame_id', ''))
            if length > MAX_NAME:
                self.get_logger().warning(
                    f'{topic}: a message is ignored, its frame_id has {length} characters, '
                    f'{MAX_NAME} are accepted',
                    throttle_duration_sec=5.0,
                )
                return None
            return callback(message, *info)

        return bounded

    def _conventions(
        self, msg_type: Any, topic: str, profile: Any, kwargs: dict[str, Any], publishes: bool
    ) -> tuple[Any, dict[str, Any]]:
        if topic in OF_ROS:  # created before there are parameters
            return profile, kwargs
        profile = copy.copy(profile)  # rclpy writes the overrides into it
        name = self.resolve_topic_name(topic)
        self._types[name] = _type_name(msg_type)

        def tell(event: Any) -> None:
            policy = QoSPolicyKind(event.last_policy_kind)
            self._tell_incompatible(name, profile, policy, publishes)

        events = PublisherEventCallbacks if publishes else SubscriptionEventCallbacks
        theirs = {
            'qos_overriding_options': QoSOverridingOptions(OVERRIDDEN),
            'event_callbacks': events(incompatible_qos=tell),
        }
        return profile, theirs | kwargs

    def _tell_incompatible(
        self, topic: str, profile: Any, policy: QoSPolicyKind, publishes: bool
    ) -> None:
        find = (
            self.get_subscriptions_info_by_topic
            if publishes
            else self.get_publishers_info_by_topic
        )
        ours = profile if isinstance(profile, QoSProfile) else QoSProfile(depth=profile)
        word = policy.name.lower()
        own, other = ('publisher', 'subscription') if publishes else ('subscription', 'publisher')
        verbs = ('offers', 'asks for') if publishes else ('asks for', 'offers')
        found = []
        for info in find(topic):
            pair = (ours, info.qos_profile) if publishes else (info.qos_profile, ours)
            offered, asked = (getattr(profile, word) for profile in pair)
            if offered > asked:  # the stricter policies come first
                name = f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                found.append(f'{name} {verbs[1]} {_value(info.qos_profile, word)}')
        who = ', '.join(found) or f'a {other} of another node {verbs[1]} another {word}'
        self.get_logger().warning(
            f'{topic}: {word} does not fit, no messages pass: this {own} {verbs[0]} '
            f'{_value(ours, word)}, {who}; qos_overrides.{topic}.{own}.{word} changes ours'
        )

    def _look_around(self) -> None:
        self._name_unknown_parameters()
        self._compare_types()

    def _compare_types(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            own = self._types.get(topic)
            if own is None or len(types) < 2:
                continue
            for word, find in (
                ('publishes', self.get_publishers_info_by_topic),
                ('subscribes to', self.get_subscriptions_info_by_topic),
            ):
                for info in find(topic):
                    name = f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                    told = (topic, name, info.topic_type)
                    if info.topic_type != own and told not in self._told:
                        self._told.add(told)
                        self.get_logger().warning(
                            f'{topic} is {own} here, but {name} {word} {info.topic_type}: '
                            'no messages pass between them'
                        )


@contextmanager
def _override_errors(topic: str) -> Iterator[None]:
    """Name the topic in what rclpy raises for an override that is no policy or out of range."""
    try:
        yield
    except (RuntimeError, AssertionError, InvalidQosOverridesError) as error:
        raise ValueError(f'{topic}: {error}') from error


def _type_name(msg_type: Any) -> str:
    package, kind, *_ = msg_type.__module__.split('.')
    return f'{package}/{kind}/{msg_type.__name__}'


def _value(profile: QoSProfile, policy: str) -> str:
    value = getattr(profile, policy)
    return str(getattr(value, 'name', value)).lower()
