"""The policy node and its lifecycle; `session` has its behaviour while configured."""

import secrets
import traceback
from typing import Any

from metagcttt_core.training.numerics import resolve_precision
from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import NameValidationException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.validate_topic_name import validate_topic_name
from std_srvs.srv import SetBool
import torch

from metagcttt.conventions import ConventionalNode
from metagcttt.deployment import deployment_of, warm_up
from metagcttt.diagnostics import Diagnostics
from metagcttt.health import Health, Level
from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import POLICY_NODE
from metagcttt.policy.session import inner_loop, PolicySession


class PolicyNode(ConventionalNode, LifecycleNode):
    """Loads a policy and its dataset when configured, and acts on goals while active."""

    def __init__(self, **kwargs: Any) -> None:
        """Declare the parameters and, with `autostart`, configure and activate.

        Args:
            kwargs: For `rclpy.node.Node`.
        """
        super().__init__('policy_node', **kwargs)
        self._session: PolicySession | None = None
        self._instance = secrets.randbits(64)
        self._enabled = True
        self._settings = ParameterSet(
            self, POLICY_NODE, is_configured=lambda: self._session is not None
        )
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._on_parameters_set)
        self.create_service(SetBool, 'enable', self._on_enable)
        self._failure = ''  # of the latest configuration
        self._diagnostics = Diagnostics(
            self, self._examine, self._settings['diagnostics_period_s']
        )
        if self._settings['autostart']:
            if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
                self.trigger_activate()

    def _LifecycleNodeMixin__change_state(self, transition_id: int) -> TransitionCallbackReturn:
        """Refuse a transition that there is not in this state; rclpy's own ends the process."""
        transitions = {number for number, *_ in self._state_machine.available_transitions}
        if transition_id in transitions:
            return super()._LifecycleNodeMixin__change_state(transition_id)  # type: ignore[misc]
        _, state = self._state_machine.current_state
        self.get_logger().warning(f'refused transition {transition_id}: the node is {state}')
        return TransitionCallbackReturn.FAILURE

    def _LifecycleNodeMixin__execute_callback(
        self, current_state_id: int, previous_state: LifecycleState
    ) -> TransitionCallbackReturn:
        """Say why a transition fails; rclpy's own is silent and finalises the node for ever."""
        callback = self._callbacks.get(current_state_id)
        try:
            return callback(previous_state) if callback else TransitionCallbackReturn.SUCCESS
        except Exception as error:  # noqa: BLE001 - this is a guard, see `guard`
            _, state = self._state_machine.current_state
            self._failure = f'{state} failed: {type(error).__name__}: {error}'
            text = ''.join(traceback.format_exception(error))
            self.get_logger().error(f'{self._failure}\n{text}')
            return TransitionCallbackReturn.FAILURE

    def destroy_node(self) -> None:
        """End the adaptation thread, then destroy the node."""
        self._close_session()
        super().destroy_node()
        # rclpy forgets this one, and it keeps the node visible to others.
        self._state_machine.destroy_when_not_in_use()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load policy and dataset, and connect; a failure leaves the node unconfigured."""
        try:
            deployment = deployment_of(self._settings)
            if self._settings['adapter']:
                validate_topic_name(self._settings['adapter'], is_service=True)
            deployment.check_optimizer_state(self._settings['optimizer_state'])
            engine = warm_up(deployment, inner_loop(self._settings))
        except (OSError, ValueError, NameValidationException) as error:
            # rclpy would swallow it silently.
            self._failure = f'cannot configure: {error}'
            self.get_logger().error(self._failure)
            return TransitionCallbackReturn.FAILURE
        if self._settings['threads']:
            torch.set_num_threads(self._settings['threads'])
        self._failure = ''
        self._session = PolicySession(
            self,
            self._settings,
            deployment,
            engine=engine,
            instance=self._instance,
            enabled=self._enabled,
        )
        agent, dataset = deployment.agent, deployment.dataset
        self.get_logger().info(
            f'{agent.name} policy for observations of {agent.obs_dim} and actions of '
            f'{agent.act_dim} values; {dataset.num_episodes} trajectories, '
            f'{dataset.num_transitions} transitions; gradient steps by engine {engine}, with '
            f'products in {resolve_precision(self._settings["precision"], agent)}'
        )
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start acting."""
        super().on_activate(state)  # publishers first
        if self._session is not None:
            self._session.start()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop acting, in realtime with a zero action."""
        if self._session is not None:
            self._session.stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the session, which frees the policy and the dataset."""
        self._close_session()
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_cleanup

    def _close_session(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._enabled = request.data
        if self._session is not None:
            self._session.enable(self._enabled)
        response.success = True
        response.message = 'enabled' if self._enabled else 'disabled: every action is zero'
        return response

    def _examine(self) -> Health:
        if self._session is not None:
            return self._session.examine()
        level = Level.ERROR if self._failure else Level.OK
        return Health(level, self._failure or 'not configured')

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                if parameter.name == 'optimizer_state' and self._session is not None:
                    self._session.deployment.check_optimizer_state(parameter.value)
                if parameter.name == 'engine' and self._session is not None:
                    self._session.deployment.check_engine(parameter.value)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_parameters_set(self, parameters: list[Parameter]) -> None:
        if self._session is not None and any(p.name == 'rate_hz' for p in parameters):
            self._session.pace()
