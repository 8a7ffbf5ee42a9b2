"""The lifecycle node that filters, adapts and acts for every goal query."""

from functools import partial
from typing import Any

from metagcttt_core import FilterConfig, TTTConfig
from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_interfaces.msg import ActionCommand, AdaptationReport, GoalQuery, MazeState
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.timer import Timer
import torch

from metagcttt.adaptation_worker import AdaptationWorker
from metagcttt.converters import action_message, report_message, to_array, vector_fault
from metagcttt.deployment import answer_query, Deployment, load_deployment, Outcome
from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import POLICY_NODE
from metagcttt.pilot import choose, Query, State
from metagcttt.qos import COMMAND, EVENTS, LATCHED, state_profile

WARNING_PERIOD_S = 5.0


class PolicyNode(LifecycleNode):
    """Acts on the goal in force: with the base policy, then with the expert adapted to the goal.

    Adaptations run in a thread of their own; everything else, and every change of this object,
    happens in the thread that spins the node.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Declare the parameters and, with `autostart`, configure and activate.

        Args:
            kwargs: For `rclpy.node.Node`.
        """
        super().__init__('policy_node', **kwargs)
        self._deployment: Deployment | None = None
        self._worker: AdaptationWorker[Query, Outcome] | None = None
        self._timer: Timer | None = None
        self._acting = False
        self._query: Query | None = None
        self._state: State | None = None
        self._state_time = self.get_clock().now()
        self._answered = True  # whether the newest state got its action, in lockstep
        self._settings = ParameterSet(
            self, POLICY_NODE, is_configured=lambda: self._deployment is not None
        )
        self.add_post_set_parameters_callback(self._on_parameters_set)
        self._adaptation_finished = self.create_guard_condition(self._on_adaptation_finished)
        if self._settings['autostart']:
            if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
                self.trigger_activate()

    def destroy_node(self) -> None:
        """End the adaptation thread, then destroy the node."""
        self._free()
        super().destroy_node()
        # rclpy forgets this one, and it keeps the node visible to others.
        self._state_machine.destroy_when_not_in_use()

    # --- lifecycle ---------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load policy and dataset, and connect; a failure leaves the node unconfigured."""
        try:
            deployment = load_deployment(
                self._settings['checkpoint'],
                self._settings['dataset'],
                FilterConfig(
                    epsilon=self._settings['epsilon'],
                    top_percent=self._settings['top_percent'],
                ),
            )
        except (OSError, ValueError) as error:
            self.get_logger().error(f'cannot configure: {error}')
            return TransitionCallbackReturn.FAILURE
        threads = self._settings['threads']
        if threads:
            torch.set_num_threads(threads)
        self._deployment = deployment
        self._worker = AdaptationWorker(self._adaptation_finished.trigger, threads)
        self._lockstep = self._settings['stepping'] == 'lockstep'
        self._actions = self.create_lifecycle_publisher(ActionCommand, 'action', COMMAND)
        self._reports = self.create_lifecycle_publisher(AdaptationReport, 'adaptation', EVENTS)
        profile = state_profile(self._settings['stepping'])
        self._inputs = (
            self.create_subscription(MazeState, 'state', self._on_state, profile),
            self.create_subscription(GoalQuery, 'goal', self._on_goal, LATCHED),
        )
        agent = deployment.agent
        self.get_logger().info(
            f'{agent.name} policy for observations of {agent.obs_dim} and actions of '
            f'{agent.act_dim} values; {deployment.dataset.num_episodes} trajectories, '
            f'{deployment.dataset.num_transitions} transitions'
        )
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start acting."""
        super().on_activate(state)
        self._acting = True
        self._pace()
        self._proceed()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop, in realtime with a zero action; a goal in force is taken up again later."""
        self._acting = False
        self._worker.cancel()
        if self._query is not None:
            self._query.adapted_at = None
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
            self._publish_action(None)
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Disconnect and free the policy and the dataset."""
        self._free()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop and free everything, for good."""
        self._free()
        return TransitionCallbackReturn.SUCCESS

    def _free(self) -> None:
        self._acting = False
        if self._deployment is None:
            return
        self._worker.close()
        self._worker.take_finished()
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        for publisher in (self._actions, self._reports):
            self.destroy_lifecycle_publisher(publisher)
        self._deployment = self._worker = self._query = self._state = None

    def _pace(self) -> None:
        """(Re)start the timer that acts in realtime."""
        if self._lockstep:
            return
        if self._timer is not None:
            self.destroy_timer(self._timer)
        self._timer = self.create_timer(1.0 / self._settings['rate_hz'], self._on_tick)

    def _on_parameters_set(self, parameters: list[Parameter]) -> None:
        if self._acting and any(parameter.name == 'rate_hz' for parameter in parameters):
            self._pace()

    # --- what arrives ------------------------------------------------------------------------

    def _on_state(self, message: MazeState) -> None:
        observation = to_array(message.observation)
        self._state = State(
            episode_id=message.episode_id,
            step=message.step,
            observation=observation,
            ended=message.terminated or message.truncated,
            fault=vector_fault('the state', observation, self._deployment.agent.obs_dim),
        )
        self._state_time = self.get_clock().now()
        self._answered = False
        query = self._query
        if query is not None and query.adapting and not query.serves(self._state):
            self._worker.cancel()
        self._proceed()

    def _on_goal(self, message: GoalQuery) -> None:
        self._worker.cancel()
        self._query = None
        goal = to_array(message.goal)
        fault = vector_fault('the goal', goal, self._deployment.agent.obs_dim)
        if not message.active:
            self.get_logger().info(f'goal {message.query_id} is over')
        elif fault:
            self.get_logger().error(f'goal {message.query_id} is refused: {fault}')
            self._publish_report(message.query_id, message.episode_id, reason=fault)
        else:
            self._query = Query(
                query_id=message.query_id,
                episode_id=message.episode_id,
                goal=goal,
                seed=message.seed,
                config=self._ttt_config(),
                hold=self._settings['adaptation'] == 'hold',
                expert=self._deployment.agent,
            )
        self._proceed()
        if self._query is None and self._timer is not None:
            self._on_tick()  # a stop does not wait for the next tick

    def _ttt_config(self) -> TTTConfig:
        return TTTConfig(
            steps=self._settings['adapt_steps'],
            lr=self._settings['adapt_lr'],
            batch_size=self._settings['adapt_batch_size'],
            early_stopping=self._settings['early_stopping'],
            actor_only=self._settings['actor_only'],
            horizon=self._settings['horizon'] or None,
        )

    # --- adapting ----------------------------------------------------------------------------

    def _proceed(self) -> None:
        """Do what the newest state and goal ask for: adapt and, in lockstep, act."""
        query, state = self._query, self._state
        if not self._acting or query is None or state is None:
            return
        if query.needs_adaptation(state):
            self._adapt(query, state)
        if self._lockstep and not self._answered and query.has_action(state):
            self._answered = True
            self._publish_action(query)

    def _adapt(self, query: Query, state: State) -> None:
        query.adapted_at = state.step
        answer = partial(
            answer_query,
            self._deployment,
            state.observation,
            query.goal,
            query.config,
            query.seed,
        )
        if query.config.steps == 0:
            self._conclude(query, answer(lambda: False))
        else:
            query.adapting = True
            self._worker.start(query, answer)

    def _on_adaptation_finished(self) -> None:
        for query, future in self._worker.take_finished() if self._worker else ():
            query.adapting = False
            reason = 'cancelled by a newer goal, a newer episode or a stop'
            if not future.cancelled():
                try:
                    self._conclude(query, future.result())
                    continue
                except AdaptationCancelled:
                    pass
                except (ValueError, RuntimeError) as error:
                    reason = f'failed: {error}'
                    self.get_logger().error(f'adaptation to goal {query.query_id} {reason}')
            self._publish_report(query.query_id, query.episode_id, reason=reason)
        self._proceed()

    def _conclude(self, query: Query, outcome: Outcome) -> None:
        query.expert = outcome.adaptation.agent
        query.adapted = outcome.adaptation.accepted
        self._publish_report(query.query_id, query.episode_id, outcome)

    # --- what is published -------------------------------------------------------------------

    def _on_tick(self) -> None:
        if self._state is None:
            return
        age_s = (self.get_clock().now() - self._state_time).nanoseconds / 1e9
        if age_s > self._settings['state_timeout_s']:
            self._warn(f'no state for {age_s:.1f} s')
            self._publish_action(None)
        else:
            self._publish_action(self._query)

    def _publish_action(self, query: Query | None) -> None:
        """Publish the action for the newest state; zero without a query."""
        state = self._state
        if state is None:
            return
        if state.fault:
            self._warn(state.fault)
        command = choose(state, query, self._deployment.agent.act_dim)
        self._actions.publish(
            action_message(
                self.get_clock().now().to_msg(),
                episode_id=state.episode_id,
                step=state.step,
                query_id=command.query_id,
                values=command.values,
                adapted=command.adapted,
            )
        )

    def _publish_report(
        self, query_id: int, episode_id: int, outcome: Outcome | None = None, reason: str = ''
    ) -> None:
        report = report_message(
            self.get_clock().now().to_msg(),
            query_id=query_id,
            episode_id=episode_id,
            support=outcome and outcome.support,
            adaptation=outcome and outcome.adaptation,
            reason=reason,
        )
        self._reports.publish(report)
        verdict = f'adapted in {report.adapt_ms:.0f} ms' if report.accepted else 'not adapted'
        self.get_logger().info(
            f'goal {query_id}: {report.transitions} transitions of {report.kept_trajectories} of '
            f'{report.relevant_trajectories} trajectories in {report.filter_ms:.1f} ms; {verdict}'
            f'{": " if report.reason else ""}{report.reason}'
        )

    def _warn(self, fault: str) -> None:
        self.get_logger().warning(
            f'the action is zero: {fault}', throttle_duration_sec=WARNING_PERIOD_S
        )
