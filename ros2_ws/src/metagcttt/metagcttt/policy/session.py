"""A configured policy on the graph: takes states and goals, adapts and acts."""

from dataclasses import replace
import time

from metagcttt_core import TTTConfig
from metagcttt_interfaces.msg import GoalQuery, MazeState, PolicyStatus
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode
from rclpy.timer import Timer

from metagcttt.converters import to_array
from metagcttt.health import Health
from metagcttt.input_checks import StateOrder, vector_fault
from metagcttt.parameter_set import ParameterSet
from metagcttt.policy.adapter import QueryAdapter
from metagcttt.policy.deployment import Deployment
from metagcttt.policy.health import Limits, PolicyMonitor
from metagcttt.policy.pilot import choose, Query, State
from metagcttt.policy.publishers import PolicyPublishers
from metagcttt.policy.safety import Safety
from metagcttt.qos import LATCHED, state_profile

WARNING_PERIOD_S = 5.0
WATCH_PERIOD_S = 0.1


class PolicySession:
    """What the policy node has between configuration and cleanup.

    Acts on the goal in force: with the base policy, then with the expert adapted to the goal.
    Adaptations run in a thread of their own; everything else, and every change of this object,
    happens in the thread that spins the node.
    """

    def __init__(
        self,
        node: LifecycleNode,
        settings: ParameterSet,
        deployment: Deployment,
        *,
        instance: int,
        enabled: bool = True,
    ) -> None:
        """Connect; nothing is published before `start`.

        Args:
            node: The node to connect through.
            settings: Its parameters.
            deployment: Policy and dataset.
            instance: Number that tells this policy from others in the graph.
            enabled: Whether actions may be other than zero.
        """
        self._node = node
        self._settings = settings
        self._deployment = deployment
        self._instance = instance
        self._lockstep = settings['stepping'] == 'lockstep'
        self._acting = False
        self._timer: Timer | None = None
        self._query: Query | None = None
        self._goal_message: GoalQuery | None = None
        self._state: State | None = None
        self._received_ns = 0  # when the newest state was; 0 once it is answered
        self._answered = True  # whether the newest state got its action, in lockstep
        self._order = StateOrder()
        self._monitor = PolicyMonitor()
        self._safety = Safety(enabled=enabled)
        self._say = PolicyPublishers(node, instance)
        self._adapter = QueryAdapter(
            node, settings, deployment, self._say, self._monitor, self._proceed
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._watch = node.create_timer(WATCH_PERIOD_S, self._on_watch, clock=steady)
        profile = state_profile(settings['stepping'])
        self._inputs = (
            node.create_subscription(
                MazeState,
                'state',
                self._on_state,  # type: ignore[arg-type] # rclpy gives it the info as well
                profile,
            ),
            node.create_subscription(GoalQuery, 'goal', self._on_goal, LATCHED),
            node.create_subscription(PolicyStatus, 'policy_status', self._on_status, LATCHED),
        )

    def start(self) -> None:
        """Act from now on, beginning with the state and the goal that came before."""
        self._acting = True
        self.pace()
        self._proceed()

    def stop(self) -> None:
        """Stop, in realtime with a zero action; a goal in force is taken up again later."""
        self._acting = False
        self._adapter.cancel()
        if self._query is not None:
            self._query.adapted_at = None
        if self._timer is not None:
            self._stop_timer()
            self._publish_action(None)

    def enable(self, enabled: bool) -> None:
        """Let actions be other than zero, or not; takes effect at once."""
        self._safety.enabled = enabled
        if self._timer is not None:
            self._on_tick()

    def close(self) -> None:
        """Disconnect and end the adaptation thread."""
        self._acting = False
        self._stop_timer()
        self._adapter.close()
        for subscription in self._inputs:
            self._node.destroy_subscription(subscription)
        self._node.destroy_timer(self._watch)
        self._say.destroy()

    def pace(self) -> None:
        """(Re)start the timer that acts in realtime, at the rate set now."""
        if self._acting and not self._lockstep:
            self._stop_timer()
            period_s = 1.0 / self._settings['rate_hz']
            self._timer = self._node.create_timer(period_s, self._on_tick)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
            self._monitor.deadlines.pause()

    # --- what arrives ------------------------------------------------------------------------

    def _on_state(self, message: MazeState, info: dict[str, int]) -> None:
        now_s = time.monotonic()
        self._monitor.states.add(now_s)
        out_of_order = ''
        if not self._lockstep:  # there an answer names the one state that it is for
            out_of_order = self._order.refusal(message.episode_id, message.step)
        observation = to_array(message.observation)
        fault = vector_fault('the state', observation, self._deployment.agent.obs_dim)
        if out_of_order:
            self._monitor.faults.note('states_out_of_order', out_of_order, now_s)
        elif fault:
            self._monitor.faults.note('malformed_states', fault, now_s)
        if out_of_order and self._state is not None:
            # The simulator heeds actions for the episode it is in.
            self._state = replace(self._state, fault=out_of_order)
        else:
            self._state = State(
                episode_id=message.episode_id,
                step=message.step,
                observation=observation,
                ended=message.terminated or message.truncated,
                fault=fault,
            )
        self._safety.saw_state(now_s, self._clock_s())
        self._received_ns = info['received_timestamp']
        self._answered = False
        query = self._query
        if query is not None and query.adapting and not query.serves(self._state):
            self._adapter.cancel()
        self._proceed()

    def _on_status(self, message: PolicyStatus) -> None:
        if message.instance != self._instance:
            self._safety.rivals.saw(message.instance, time.monotonic())

    def _on_goal(self, message: GoalQuery) -> None:
        self._safety.saw_goal(time.monotonic(), message.lease_s if message.active else 0.0)
        if message == self._goal_message:
            return  # repeated, so that its silence means that the goal node is gone
        self._goal_message = message
        self._adapter.cancel()
        self._query = None
        goal = to_array(message.goal)
        fault = vector_fault('the goal', goal, self._deployment.agent.obs_dim)
        if not message.active:
            self._node.get_logger().info(f'goal {message.query_id} is over')
        elif fault:
            self._node.get_logger().error(f'goal {message.query_id} is refused: {fault}')
            self._say.report(message.query_id, message.episode_id, reason=fault)
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
            test_fraction=self._settings['test_fraction'],
            actor_only=self._settings['actor_only'],
            horizon=self._settings['horizon'] or None,
        )

    # --- what is done with it ----------------------------------------------------------------

    def _proceed(self) -> None:
        """Do what the newest state and goal ask for: adapt and act."""
        query, state = self._query, self._state
        if not self._acting or query is None or state is None:
            return
        if query.needs_adaptation(state):
            self._adapter.adapt(query, state)
        if not self._answered and query.has_action(state):
            self._answered = True
            self._publish_action(query)
            if self._timer is not None:
                self._timer.reset()
        self._say.status(query, state)

    def _on_watch(self) -> None:
        """Look after what may stop coming; not by the node's clock, which may stand still."""
        now_s = time.monotonic()
        query = self._query
        if query is not None and self._safety.expire_goal(query.query_id, now_s):
            self._node.get_logger().error(self._safety.lost_goal)
            self._adapter.cancel()
            self._query = self._goal_message = None
        if self._timer is not None and self._zero_reason():
            self._publish_action(self._query)
        self._say.status(self._query, self._state)

    # --- what is published -------------------------------------------------------------------

    def _on_tick(self) -> None:
        self._publish_action(self._query)

    def _clock_s(self) -> float:
        return self._node.get_clock().now().nanoseconds / 1e9

    def _zero_reason(self) -> str:
        """Why the robot may not move now; empty when it may."""
        return self._safety.zero_reason(
            self._state,
            now_s=time.monotonic(),
            clock_s=self._clock_s(),
            timeout_s=float('inf') if self._lockstep else self._settings['state_timeout_s'],
        )

    def _publish_action(self, query: Query | None) -> None:
        """Publish the action for the newest state; zero without a query."""
        state = self._state
        if state is None:
            return
        act_dim = self._deployment.agent.act_dim
        zero_reason = self._zero_reason()
        if zero_reason:
            command = choose(replace(state, fault=zero_reason), query, act_dim)
        else:
            command = choose(state, query, act_dim)
            if command.fault:
                zero_reason = command.fault
                self._monitor.faults.note('unusable_actions', zero_reason, time.monotonic())
        if zero_reason:
            self._warn(zero_reason)
        self._say.action(state, command)
        self._measure()

    def _measure(self) -> None:
        now_s = time.monotonic()
        self._monitor.actions.add(now_s)
        if self._received_ns:
            self._monitor.latency_ms.add((time.time_ns() - self._received_ns) / 1e6)
            self._received_ns = 0
        if self._timer is None or self._state is None:
            return
        if not self._node.get_parameter('use_sim_time').value:
            self._monitor.deadlines.met(now_s, 1.0 / self._settings['rate_hz'])
        elif self._query is not None and self._query.has_action(self._state):
            self._monitor.deadlines.answered(now_s, self._state.episode_id, self._state.step)
        else:
            self._monitor.deadlines.pause()

    def _no_source_reason(self) -> str:
        # In lockstep no state gets too old.
        return '' if self._node.count_publishers('state') else 'nobody publishes states'

    def examine(self) -> Health:
        """How the policy is."""
        return self._monitor.examine(
            acting=self._acting,
            zero_reason=self._zero_reason() or self._no_source_reason(),
            query=self._query,
            num_publishers=self._node.count_publishers('action'),
            num_pending=self._adapter.num_pending,
            limits=Limits(
                latency_ms=self._settings['warn_latency_ms'],
                missed_deadlines=self._settings['warn_missed_deadlines'],
                adapt_ms=self._settings['warn_adapt_ms'],
            ),
        )

    def _warn(self, fault: str) -> None:
        self._node.get_logger().warning(
            f'the action is zero: {fault}', throttle_duration_sec=WARNING_PERIOD_S
        )
