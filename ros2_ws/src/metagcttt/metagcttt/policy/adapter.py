"""Adaptation to goals beside the control loop, in this node or by an adapter."""

from collections.abc import Callable, Hashable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from functools import partial
from typing import Any

from metagcttt_core import Adaptation
from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_interfaces.msg import Expert
from rclpy.lifecycle import LifecycleNode

from metagcttt.adaptation_messages import ExpertError, to_adaptation
from metagcttt.deployment import adapt_to_goal, Deployment, prefetch_values
from metagcttt.parameter_set import ParameterSet
from metagcttt.policy.decision import Progress, Pursuit, State
from metagcttt.policy.expert_cache import ExpertCache
from metagcttt.policy.health import PolicyMonitor
from metagcttt.policy.publishers import PolicyPublishers
from metagcttt.policy.remote import RemoteAdapter
from metagcttt.policy.worker import AdaptationWorker

CANCELLED = 'cancelled by a newer goal, a newer episode or a stop'


@dataclass(frozen=True)
class _Order:
    """An adaptation to be made.

    Attributes:
        pursuit: What it is for.
        key: Of the expert cache.
        job: The adaptation in this node.
    """

    pursuit: Pursuit
    key: Hashable
    job: Callable[[Callable[[], bool]], Adaptation]


class GoalAdapter:
    """Adapts to goals and reports the results.

    Gradient steps are taken in a background thread, or by an adapter, whose experts are checked in
    that thread; a `Pursuit` is changed only in the thread that spins the node. Between two
    adaptations to one goal (with a horizon) the background thread evaluates the critic for the
    next one.
    """

    def __init__(
        self,
        node: LifecycleNode,
        settings: ParameterSet,
        deployment: Deployment,
        publishers: PolicyPublishers,
        monitor: PolicyMonitor,
        on_ended: Callable[[], None],
        instance: int,
    ) -> None:
        """Start the background thread.

        Args:
            node: The node whose thread receives the experts.
            settings: Its parameters.
            deployment: Policy and dataset.
            publishers: For the reports.
            monitor: For the diagnostics.
            on_ended: Called when adaptations have ended.
            instance: Random number that identifies this policy in the graph.
        """
        self._node = node
        self._settings = settings
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
        self._asked: _Order | None = None  # of the adapter, which has not answered yet
        self._remote = None
        if settings['adapter']:
            self._remote = RemoteAdapter(
                node, settings['adapter'], deployment, instance, self._on_expert, self._fall_back
            )
            monitor.adapter = self._remote.name

    @property
    def num_pending(self) -> int:
        """Number of jobs whose result was not handled yet."""
        return self._worker.num_pending + (self._asked is not None)

    def adapt(self, pursuit: Pursuit, state: State) -> None:
        """Adapt to a goal from a state; cancels the adaptation under way."""
        goal, config = pursuit.goal, pursuit.config
        pursuit.adapted_at, pursuit.fallback = state.step, ''
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
            return
        pursuit.adapting = True
        order = _Order(pursuit, key, job)
        if self._remote is None:
            self._start(order, job)
        else:
            self._asked = order
            timeout_s = self._settings['adapter_timeout_s']
            self._remote.ask(state.observation, goal, config, timeout_s)

    def cancel(self) -> None:
        """Cancel the adaptation under way, within one gradient step."""
        self._worker.cancel()
        if self._remote is not None and self._asked is not None:
            self._remote.cancel()
            pursuit, self._asked = self._asked.pursuit, None
            pursuit.adapting = False
            self._report_base(pursuit, CANCELLED)

    def check_time(self) -> None:
        """Give up waiting for the adapter when the time is up; to be called often."""
        if self._remote is not None:
            self._remote.check_time()

    def close(self) -> None:
        """Cancel and join the background thread."""
        if self._remote is not None:
            self._remote.close()
        self._worker.close()
        self._node.destroy_guard_condition(self._finished)

    def _start(self, order: _Order, job: Callable[[Callable[[], bool]], Adaptation]) -> None:
        self._worker.start(partial(self._on_adapted, order), job)

    def _on_expert(self, message: Expert) -> None:
        """Check an expert of the adapter as if it was adapted here."""
        order, self._asked = self._asked, None
        assert order is not None and self._remote is not None
        deployment, config, name = self._deployment, order.pursuit.config, self._remote.name
        self._start(
            order,
            lambda should_stop: to_adaptation(
                message, deployment.agent, deployment.dataset, config, name
            ),
        )

    def _fall_back(self, reason: str) -> None:
        """Do without the adapter, which did not adapt for that reason."""
        order, self._asked = self._asked, None
        assert order is not None
        self._do_without(order, reason)
        self._on_ended()

    def _do_without(self, order: _Order, reason: str) -> None:
        assert self._remote is not None
        pursuit = order.pursuit
        pursuit.fallback = f'the adapter {self._remote.name} {reason}'
        self._monitor.num_fallbacks += 1
        self._node.get_logger().warning(f'goal {pursuit.goal.query_id}: {pursuit.fallback}')
        if self._settings['adapter_fallback'] == 'local':
            pursuit.adapting = True
            self._start(order, order.job)
        else:
            pursuit.adapting = False
            self._stay(pursuit, pursuit.fallback)

    def _on_finished(self) -> None:
        for handle, future in self._worker.take_finished():
            handle(future)
        self._on_ended()

    def _on_adapted(self, order: _Order, future: 'Future[Adaptation]') -> None:
        pursuit = order.pursuit
        pursuit.adapting = False
        base = self._deployment.agent
        try:
            adaptation = future.result()
        except (AdaptationCancelled, CancelledError):
            self._report_base(pursuit, CANCELLED)
        except ExpertError as error:
            self._do_without(order, f'sent a false expert: {error}')
        except (ValueError, RuntimeError) as error:
            self._node.get_logger().error(f'goal {pursuit.goal.query_id}: failed: {error}')
            self._stay(pursuit, f'failed: {error}')
        else:
            self._monitor.adapted(adaptation)
            self._cache.keep(order.key, adaptation)
            self._conclude(pursuit, adaptation)
            if pursuit.config.horizon and base.value_fn is not None and not adaptation.adapter:
                job = partial(prefetch_values, self._deployment, pursuit.goal)
                self._worker.start(self._on_prefetched, job)

    def _stay(self, pursuit: Pursuit, reason: str) -> None:
        """Go on with the weights that act now, and report why."""
        if not pursuit.adaptation.accepted:
            pursuit.adaptation = Adaptation(self._deployment.agent, reason=reason)
        self._report_base(pursuit, reason)

    def _report_base(self, pursuit: Pursuit, reason: str) -> None:
        self._publishers.publish_report(
            pursuit.goal, Adaptation(self._deployment.agent, reason=reason)
        )

    def _conclude(self, pursuit: Pursuit, adaptation: Adaptation, *, cached: bool = False) -> None:
        pursuit.adaptation = adaptation
        pursuit.progress = Progress(len(adaptation.train_losses))
        self._publishers.publish_report(
            pursuit.goal, adaptation, cached=cached, remark=pursuit.fallback
        )

    def _on_prefetched(self, future: 'Future[None]') -> None:
        if not future.cancelled() and future.exception() is not None:
            self._node.get_logger().error(f'the critic cannot be used: {future.exception()}')
