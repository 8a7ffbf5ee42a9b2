"""Adaptation to goals beside the control loop."""

from collections.abc import Callable, Hashable
from concurrent.futures import CancelledError, Future
from functools import partial
from typing import Any

from metagcttt_core import Adaptation
from metagcttt_core.adaptation import AdaptationCancelled
from rclpy.lifecycle import LifecycleNode

from metagcttt.parameter_set import ParameterSet
from metagcttt.policy.decision import Progress, Pursuit, State
from metagcttt.policy.deployment import adapt_to_goal, Deployment, prefetch_values
from metagcttt.policy.expert_cache import ExpertCache
from metagcttt.policy.health import PolicyMonitor
from metagcttt.policy.publishers import PolicyPublishers
from metagcttt.policy.worker import AdaptationWorker

CANCELLED = 'cancelled by a newer goal, a newer episode or a stop'


class GoalAdapter:
    """Adapts to goals and reports the results.

    Gradient steps are taken in a background thread; a `Pursuit` is changed only in the thread that
    spins the node. Between two adaptations to one goal (with a horizon) the background thread
    evaluates the critic for the next one.
    """

    def __init__(
        self,
        node: LifecycleNode,
        settings: ParameterSet,
        deployment: Deployment,
        publishers: PolicyPublishers,
        monitor: PolicyMonitor,
        on_ended: Callable[[], None],
    ) -> None:
        """Start the background thread.

        Args:
            node: The node whose thread receives the experts.
            settings: Its parameters.
            deployment: Policy and dataset.
            publishers: For the reports.
            monitor: For the diagnostics.
            on_ended: Called when adaptations have ended.
        """
        self._node = node
        self._deployment = deployment
        self._publishers = publishers
        self._monitor = monitor
        self._on_ended = on_ended
        self._finished = node.create_guard_condition(self._on_finished)
        self._worker: AdaptationWorker[Callable[[Future[Any]], None], Any] = AdaptationWorker(
            self._finished.trigger, settings['threads']
        )
        self._cache = ExpertCache(
            settings['cache_size'],
            settings['cache_cell_m'],
            deployment.trajectory_filter.config.position_dims,
        )

    @property
    def num_pending(self) -> int:
        """Number of jobs whose result was not handled yet."""
        return self._worker.num_pending

    def adapt(self, pursuit: Pursuit, state: State) -> None:
        """Adapt to a goal from a state; cancels the adaptation under way."""
        goal, config = pursuit.goal, pursuit.config
        pursuit.adapted_at = state.step
        key = self._cache.key(state.observation, goal.observation, config)
        cached = self._cache.find(key)
        if cached is not None:
            self._conclude(pursuit, cached, cached=True)
            return
        pursuit.progress = Progress()
        job = partial(
            adapt_to_goal,
            self._deployment,
            state.observation,
            goal,
            config,
            on_step=pursuit.progress,
        )
        if config.steps == 0:
            self._conclude(pursuit, job(lambda: False))
        else:
            pursuit.adapting = True
            self._worker.start(partial(self._on_adapted, pursuit, key), job)

    def cancel(self) -> None:
        """Cancel the adaptation under way, within one gradient step."""
        self._worker.cancel()

    def close(self) -> None:
        """Cancel and join the background thread."""
        self._worker.close()
        self._node.destroy_guard_condition(self._finished)

    def _on_finished(self) -> None:
        for handle, future in self._worker.take_finished():
            handle(future)
        self._on_ended()

    def _on_adapted(self, pursuit: Pursuit, key: Hashable, future: 'Future[Adaptation]') -> None:
        pursuit.adapting = False
        base = self._deployment.agent
        try:
            adaptation = future.result()
        except (AdaptationCancelled, CancelledError):
            self._publishers.publish_report(pursuit.goal, Adaptation(base, reason=CANCELLED))
        except (ValueError, RuntimeError) as error:
            failed = Adaptation(base, reason=f'failed: {error}')
            if not pursuit.adaptation.accepted:
                pursuit.adaptation = failed
            self._node.get_logger().error(f'goal {pursuit.goal.query_id}: {failed.reason}')
            self._publishers.publish_report(pursuit.goal, failed)
        else:
            self._monitor.adapt_ms.add(1000 * adaptation.seconds)
            self._monitor.engine = adaptation.engine or self._monitor.engine
            self._cache.keep(key, adaptation)
            self._conclude(pursuit, adaptation)
            if pursuit.config.horizon and base.value_fn is not None:
                job = partial(prefetch_values, self._deployment, pursuit.goal)
                self._worker.start(self._on_prefetched, job)

    def _conclude(self, pursuit: Pursuit, adaptation: Adaptation, *, cached: bool = False) -> None:
        pursuit.adaptation = adaptation
        pursuit.progress = Progress(len(adaptation.train_losses))
        self._publishers.publish_report(pursuit.goal, adaptation, cached=cached)

    def _on_prefetched(self, future: 'Future[None]') -> None:
        if not future.cancelled() and future.exception() is not None:
            self._node.get_logger().error(f'the critic cannot be used: {future.exception()}')
