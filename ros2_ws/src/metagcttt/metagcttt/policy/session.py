"""A configured policy: receives states and goals, adapts and acts."""

import time

from metagcttt_core import Adaptation, TTTConfig
from metagcttt_interfaces.msg import GoalQuery, MazeState, PolicyStatus
from rclpy.lifecycle import LifecycleNode
from rclpy.timer import Timer

from metagcttt.clocks import JumpFreeClock, STEADY
from metagcttt.converters import to_array, to_goal
from metagcttt.deployment import Deployment
from metagcttt.health import Health
from metagcttt.input_checks import vector_fault
from metagcttt.parameter_set import ParameterSet
from metagcttt.policy.adapter import GoalAdapter
from metagcttt.policy.decision import decide, Pursuit, State
from metagcttt.policy.health import PolicyMonitor
from metagcttt.policy.publishers import PolicyPublishers
from metagcttt.policy.safety import Safety
from metagcttt.qos import LATCHED, state_profile
from metagcttt.worlds import Moment, RESTART_STATES, WorldOrder

WARNING_PERIOD_S = 5.0
WATCHDOG_PERIOD_S = 0.1


def inner_loop(settings: ParameterSet) -> TTTConfig:
    """The inner loop that the parameters ask for."""
    return TTTConfig(
        steps=settings['adapt_steps'],
        lr=settings['adapt_lr'],
        batch_size=settings['adapt_batch_size'],
        early_stopping=settings['early_stopping'],
        guard=settings['guard'],
        test_fraction=settings['test_fraction'],
        actor_only=settings['actor_only'],
        optimizer_state=settings['optimizer_state'],
        engine=settings['engine'],
        precision=settings['precision'],
        horizon=settings['horizon'] or None,
    )


class PolicySession:
    """The policy node's state and behaviour between configuration and cleanup.

    Acts on the goal in force with the base policy, then with the expert adapted to the goal.
    Adaptations run in a background thread; everything else, and every change of this object,
    happens in the thread that spins the node.

    Attributes:
        deployment: Policy and dataset.
    """

    def __init__(
        self,
        node: LifecycleNode,
        settings: ParameterSet,
        deployment: Deployment,
        *,
        engine: str,
        instance: int,
        enabled: bool = True,
    ) -> None:
        """Create publishers, subscriptions and timers; `start` begins to publish.

        Args:
            node: The node that owns them.
            settings: Its parameters.
            deployment: Policy and dataset.
            engine: What computes gradient steps, for the diagnostics.
            instance: Random number that identifies this policy in the graph.
            enabled: Whether actions may be other than zero.
        """
        self._node = node
        self._settings = settings
        self.deployment = deployment
        self._instance = instance
        self._lockstep = settings['stepping'] == 'lockstep'
        self._acting = False
        self._timer: Timer | None = None
        self._pursuit: Pursuit | None = None
        self._goal_message: str | None = None
        self._state: State | None = None
        self._received_ns = 0  # arrival of the newest state; 0 once answered
        self._answered = True  # lockstep: whether the newest state got its action
        # In lockstep, states are delivered in order, and one that begins again has no successor.
        self._order = WorldOrder(1 if self._lockstep else RESTART_STATES)
        self._clock = JumpFreeClock(node)
        self._monitor = PolicyMonitor(engine)
        self._safety = Safety(enabled=enabled)
        self._publishers = PolicyPublishers(node, instance)
        self._adapter = GoalAdapter(
            node,
            settings,
            deployment,
            self._publishers,
            self._monitor,
            self._proceed,
            instance,
        )
        self._watchdog = node.create_timer(WATCHDOG_PERIOD_S, self._on_watchdog, clock=STEADY)
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
        """Start acting, on the state and the goal received so far."""
        self._acting = True
        self.pace()
        self._proceed()

    def stop(self) -> None:
        """Stop, in realtime with a zero action; `start` resumes the goal in force."""
        self._acting = False
        self._adapter.cancel()
        if self._pursuit is not None:
            self._pursuit.adapted_at = None
        if self._timer is not None:
            self._stop_timer()
            self._publish_action(None)

    def enable(self, enabled: bool) -> None:
        """Allow actions other than zero, or not; takes effect immediately."""
        self._safety.enabled = enabled
        if self._timer is not None:
            self._on_tick()

    def close(self) -> None:
        """Destroy publishers, subscriptions and timers, and join the background thread."""
        self._acting = False
        self._stop_timer()
        self._adapter.close()
        self._clock.close()
        for subscription in self._inputs:
            self._node.destroy_subscription(subscription)
        self._node.destroy_timer(self._watchdog)
        self._publishers.destroy()

    def pace(self) -> None:
        """(Re)start the realtime action timer at the current rate."""
        if self._acting and not self._lockstep:
            self._stop_timer()
            period_s = 1.0 / self._settings['rate_hz']
            self._timer = self._node.create_timer(period_s, self._on_tick)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
            self._monitor.deadlines.pause()

    # --- input -------------------------------------------------------------------------------

    def _on_state(self, message: MazeState, info: dict[str, int]) -> None:
        now_s = time.monotonic()
        self._monitor.states.add(now_s)
        out_of_order = self._order.refuse_state(
            Moment(message.world_id, message.episode_id, message.step), info['source_timestamp']
        )
        observation = to_array(message.observation)
        fault = self.deployment.contract_fault(message.contract) or vector_fault(
            'the state', observation, self.deployment.agent.obs_dim
        )
        if out_of_order:
            self._monitor.faults.note('states_out_of_order', out_of_order, now_s)
        elif fault:
            self._monitor.faults.note('malformed_states', fault, now_s)
        if out_of_order and self._lockstep:
            return  # the simulator waits for the answer to another state
        # The simulator takes actions for its current episode only.
        if not out_of_order or self._state is None:
            self._state = State(
                episode_id=message.episode_id,
                step=message.step,
                observation=observation,
                ended=message.terminated or message.truncated,
                fault=fault,
                world_id=message.world_id,
            )
        self._safety.saw_state(now_s, self._clock.now_s(), out_of_order)
        self._received_ns = info['received_timestamp']
        self._answered = False
        pursuit = self._pursuit
        if pursuit is not None and pursuit.adapting and not pursuit.serves(self._state):
            self._adapter.cancel()
        self._proceed()

    def _on_status(self, message: PolicyStatus) -> None:
        if message.instance != self._instance:
            self._safety.rivals.saw(message.instance, time.monotonic())

    def _on_goal(self, message: GoalQuery) -> None:
        self._safety.saw_goal(time.monotonic(), message.lease_s if message.active else 0.0)
        # As text: the position of a robot that has none is NaN, which is unlike itself.
        said = repr(message)
        if said == self._goal_message:
            return  # a repetition, which only renews the lease
        self._goal_message = said
        self._adapter.cancel()
        self._pursuit = None
        goal, agent = to_goal(message), self.deployment.agent
        fault = vector_fault('the goal', goal.observation, agent.obs_dim)
        if not message.active:
            self._node.get_logger().info(f'goal {goal.query_id} is over')
        elif fault:
            self._node.get_logger().error(f'goal {goal.query_id} is refused: {fault}')
            self._publishers.publish_report(goal, Adaptation(agent, reason=fault))
        else:
            self._pursuit = Pursuit(
                goal,
                config=inner_loop(self._settings),
                hold=self._settings['adaptation'] == 'hold',
                adaptation=Adaptation(agent, reason='no state to adapt to yet'),
            )
        self._proceed()
        if self._pursuit is None and self._timer is not None:
            self._on_tick()  # a stop does not wait for the next tick

    # --- behaviour ---------------------------------------------------------------------------

    def _proceed(self) -> None:
        """Adapt and act as the newest state and goal require."""
        pursuit, state = self._pursuit, self._state
        if not self._acting or pursuit is None or state is None:
            return
        if pursuit.needs_adaptation(state):
            self._adapter.adapt(pursuit, state)
        if not self._answered and not pursuit.idle_reason(state):
            self._answered = True
            self._publish_action(pursuit)
            if self._timer is not None:
                self._timer.reset()
        self._publishers.publish_status(pursuit, state)

    def _on_watchdog(self) -> None:
        """Check the inputs for timeouts; on a steady clock, as the node's may stand still."""
        self._adapter.check_time()
        pursuit = self._pursuit
        if pursuit and self._safety.expire_goal(pursuit.goal.query_id, time.monotonic()):
            self._node.get_logger().error(self._safety.expired_goal)
            self._adapter.cancel()
            self._pursuit = self._goal_message = None
        if self._timer is not None and self._zero_reason():
            self._publish_action(self._pursuit)
        self._publishers.publish_status(self._pursuit, self._state)

    # --- output ------------------------------------------------------------------------------

    def _on_tick(self) -> None:
        self._publish_action(self._pursuit)

    def _zero_reason(self) -> str:
        """The reason why the robot may not move now; empty when it may."""
        return self._safety.zero_reason(
            self._state,
            now_s=time.monotonic(),
            clock_s=self._clock.now_s(),
            timeout_s=float('inf') if self._lockstep else self._settings['state_timeout_s'],
        )

    def _publish_action(self, pursuit: Pursuit | None) -> None:
        """Publish the command for the newest state."""
        state = self._state
        if state is None:
            return
        command = decide(state, pursuit, self._zero_reason(), self.deployment.agent.act_dim)
        if command.cause == 'unusable':
            self._monitor.faults.note('unusable_actions', command.reason, time.monotonic())
        if command.cause in ('unsafe', 'unusable'):
            self._node.get_logger().warning(
                f'the action is zero: {command.reason}', throttle_duration_sec=WARNING_PERIOD_S
            )
        self._publishers.publish_action(state, command)
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
        elif self._pursuit is not None and not self._pursuit.idle_reason(self._state):
            self._monitor.deadlines.answered(now_s, self._state.episode_id, self._state.step)
        else:
            self._monitor.deadlines.pause()

    def examine(self) -> Health:
        """The current health of the policy."""
        # In lockstep states have no timeout.
        no_source = '' if self._node.count_publishers('state') else 'nobody publishes states'
        return self._monitor.examine(
            acting=self._acting,
            zero_reason=self._zero_reason() or no_source,
            pursuit=self._pursuit,
            num_publishers=self._node.count_publishers('action'),
            num_pending=self._adapter.num_pending,
            warn_latency_ms=self._settings['warn_latency_ms'],
            warn_missed_deadlines=self._settings['warn_missed_deadlines'],
            warn_adapt_ms=self._settings['warn_adapt_ms'],
        )
