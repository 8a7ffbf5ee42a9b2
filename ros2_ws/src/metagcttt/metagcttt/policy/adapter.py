"""Adapts a policy to queries beside the control loop."""

from collections.abc import Callable
from concurrent.futures import Future
from functools import partial

from metagcttt_core.adaptation import AdaptationCancelled
from rclpy.lifecycle import LifecycleNode

from metagcttt.parameter_set import ParameterSet
from metagcttt.policy.deployment import answer_query, Deployment, Outcome, prefetch_values
from metagcttt.policy.expert_cache import ExpertCache
from metagcttt.policy.health import PolicyMonitor
from metagcttt.policy.pilot import Query, State
from metagcttt.policy.publishers import PolicyPublishers
from metagcttt.policy.worker import AdaptationWorker

CANCELLED = 'cancelled by a newer goal, a newer episode or a stop'


class QueryAdapter:
    """Gives queries their experts and reports how that went.

    Gradient steps are taken in a thread of their own; queries are changed in the thread that spins
    the node only. Between two adaptations to a goal, which there are with a horizon, that thread
    evaluates the critic for the next one.
    """

    def __init__(
        self,
        node: LifecycleNode,
        settings: ParameterSet,
        deployment: Deployment,
        announcer: PolicyPublishers,
        monitor: PolicyMonitor,
        on_ended: Callable[[], None],
    ) -> None:
        """Adapt to nothing yet.

        Args:
            node: Whose thread takes the experts over.
            settings: Its parameters.
            deployment: Policy and dataset.
            announcer: Publishes the reports.
            monitor: Gathers the figures.
            on_ended: Called when adaptations have ended.
        """
        self._node = node
        self._deployment = deployment
        self._announcer = announcer
        self._monitor = monitor
        self._on_ended = on_ended
        self._finished = node.create_guard_condition(self._on_finished)
        self._worker: AdaptationWorker[Query | None, Outcome | None] = AdaptationWorker(
            self._finished.trigger, settings['threads']
        )
        self._cache = ExpertCache(
            settings['cache_size'],
            settings['cache_cell_m'],
            deployment.trajectory_filter.config.position_dims,
        )

    @property
    def num_pending(self) -> int:
        """Jobs whose end was not seen yet."""
        return self._worker.num_pending

    def adapt(self, query: Query, state: State) -> None:
        """Adapt to a query in a state, in place of what is under way."""
        query.adapted_at = state.step
        query.cache_key = self._cache.key(state.observation, query.goal, query.config)
        known = self._cache.find(query.cache_key)
        if known is not None:
            self._conclude(query, known, cached=True)
            return
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

    def cancel(self) -> None:
        """Give up the adaptation under way, within one gradient step."""
        self._worker.cancel()

    def close(self) -> None:
        """Give up and end the thread."""
        self._worker.close()
        self._node.destroy_guard_condition(self._finished)

    def _on_finished(self) -> None:
        for query, future in self._worker.take_finished():
            if query is not None:
                query.adapting = False
                self._take_over(query, future)
            elif not future.cancelled() and future.exception() is not None:
                self._node.get_logger().error(f'the critic cannot be used: {future.exception()}')
        self._on_ended()

    def _take_over(self, query: Query, future: 'Future[Outcome | None]') -> None:
        reason = CANCELLED
        if not future.cancelled():
            try:
                outcome = future.result()
            except AdaptationCancelled:
                pass
            except (ValueError, RuntimeError) as error:
                reason = self._monitor.remark = f'failed: {error}'
                self._node.get_logger().error(f'goal {query.query_id}: {reason}')
            else:
                assert outcome is not None, 'the answer to a query'
                self._conclude(query, outcome)
                self._foresee(query)
                return
        self._announcer.report(query.query_id, query.episode_id, reason=reason)

    def _conclude(self, query: Query, outcome: Outcome, *, cached: bool = False) -> None:
        if not cached:
            self._monitor.adapt_ms.add(1000 * outcome.adaptation.seconds)
            self._cache.keep(query.cache_key, outcome)
        self._monitor.remark = outcome.adaptation.reason
        query.expert = outcome.adaptation.agent
        query.adapted = outcome.adaptation.accepted
        query.steps_done = len(outcome.adaptation.train_losses)
        self._announcer.report(query.query_id, query.episode_id, outcome, cached=cached)

    def _foresee(self, query: Query) -> None:
        if query.config.horizon and self._deployment.agent.value_fn is not None:
            self._worker.start(None, partial(prefetch_values, self._deployment, query.goal))
