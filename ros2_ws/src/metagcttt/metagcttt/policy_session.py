"""A configured policy on the graph: takes states and goals, adapts and acts."""

from functools import partial

from metagcttt_core import TTTConfig
from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_interfaces.msg import GoalQuery, MazeState
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode
from rclpy.timer import Timer

from metagcttt.adaptation_worker import AdaptationWorker
from metagcttt.converters import to_array
from metagcttt.deployment import answer_query, Deployment, Outcome
from metagcttt.parameter_set import ParameterSet
from metagcttt.pilot import choose, Query, State
from metagcttt.policy_announcer import PolicyAnnouncer
from metagcttt.qos import LATCHED, state_profile
from metagcttt.vectors import vector_fault

WARNING_PERIOD_S = 5.0
WATCH_PERIOD_S = 0.1


class PolicySession:
    """What the policy node has between configuration and cleanup.

    Acts on the goal in force: with the base policy, then with the expert adapted to the goal.
    Adaptations run in a thread of their own; everything else, and every change of this object,
    happens in the thread that spins the node.
    """

    def __init__(
        self, node: LifecycleNode, settings: ParameterSet, deployment: Deployment
    ) -> None:
        """Connect; nothing is published before `start`.

        Args:
            node: The node to connect through.
            settings: Its parameters.
            deployment: Policy and dataset.
        """
        self._node = node
        self._settings = settings
        self._deployment = deployment
        self._lockstep = settings['stepping'] == 'lockstep'
        self._acting = False
        self._timer: Timer | None = None
        self._query: Query | None = None
        self._state: State | None = None
        self._state_time = node.get_clock().now()
        self._answered = True  # whether the newest state got its action, in lockstep
        self._adaptation_finished = node.create_guard_condition(self._on_adaptation_finished)
        self._worker: AdaptationWorker[Query, Outcome] = AdaptationWorker(
            self._adaptation_finished.trigger, settings['threads']
        )
        self._say = PolicyAnnouncer(node)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._watch = node.create_timer(WATCH_PERIOD_S, self._on_watch, clock=steady)
        profile = state_profile(settings['stepping'])
        self._inputs = (
            node.create_subscription(MazeState, 'state', self._on_state, profile),
            node.create_subscription(GoalQuery, 'goal', self._on_goal, LATCHED),
        )

    def start(self) -> None:
        """Act from now on, beginning with the state and the goal that came before."""
        self._acting = True
        self.pace()
        self._proceed()

    def stop(self) -> None:
        """Stop, in realtime with a zero action; a goal in force is taken up again later."""
        self._acting = False
        self._worker.cancel()
        if self._query is not None:
            self._query.adapted_at = None
        if self._timer is not None:
            self._stop_timer()
            self._publish_action(None)

    def close(self) -> None:
        """Disconnect and end the adaptation thread."""
        self._acting = False
        self._stop_timer()
        self._worker.close()
        for subscription in self._inputs:
            self._node.destroy_subscription(subscription)
        self._node.destroy_timer(self._watch)
        self._say.destroy()
        self._node.destroy_guard_condition(self._adaptation_finished)

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
        self._state_time = self._node.get_clock().now()
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
        self._on_watch()

    def _adapt(self, query: Query, state: State) -> None:
        query.adapted_at = state.step
        answer = partial(
            answer_query,
            self._deployment,
            state.observation,
            query.goal,
            query.config,
            query.seed,
            on_step=partial(setattr, query, 'steps_done'),
        )
        if query.config.steps == 0:
            self._conclude(query, answer(lambda: False))
        else:
            query.adapting, query.steps_done = True, 0
            self._worker.start(query, answer)

    def _on_adaptation_finished(self) -> None:
        for query, future in self._worker.take_finished():
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
                    self._node.get_logger().error(f'goal {query.query_id}: {reason}')
            self._say.report(query.query_id, query.episode_id, reason=reason)
        self._proceed()

    def _conclude(self, query: Query, outcome: Outcome) -> None:
        query.expert = outcome.adaptation.agent
        query.adapted = outcome.adaptation.accepted
        query.steps_done = len(outcome.adaptation.train_losses)
        self._say.report(query.query_id, query.episode_id, outcome)

    # --- what is published -------------------------------------------------------------------

    def _on_tick(self) -> None:
        if self._state is None:
            return
        age_s = (self._node.get_clock().now() - self._state_time).nanoseconds / 1e9
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
        self._say.action(state, choose(state, query, self._deployment.agent.act_dim))

    def _on_watch(self) -> None:
        self._say.status(self._query, self._state)

    def _warn(self, fault: str) -> None:
        self._node.get_logger().warning(
            f'the action is zero: {fault}', throttle_duration_sec=WARNING_PERIOD_S
        )
