"""The scene of one maze, kept up with the graph."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
import threading
from typing import Any

from metagcttt.converters import to_array
from metagcttt_core import Agent, TTTConfig
from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_interfaces.msg import AdaptationReport
import numpy as np
import viser

from metagcttt_tools.live.fields import Deployed, expert_of, grid_of, load_deployed, Query
from metagcttt_tools.live.scene import AFTER, BEFORE, MazeScene
from metagcttt_tools.live.watch import Watch
from metagcttt_tools.recordings.goal_views import maze_of

_BEFORE_M, _AFTER_M = 0.15, 0.3  # heights of the fields


class Picture:
    """Draws what a `Watch` knows of one maze; slow work is done in a thread of `pool`.

    Attributes:
        grid: The map it was made for.
        fault: Why something is not shown, in words; empty when there is nothing new to say.
    """

    def __init__(self, server: viser.ViserServer, watch: Watch, pool: ThreadPoolExecutor) -> None:
        """Build the maze.

        Args:
            server: Whose scene it is.
            watch: The graph, which has a map.
            pool: For loading and adapting.
        """
        self.grid, self.fault = watch.grid, ''
        self._maze = maze_of(watch.grid)
        self._scene = MazeScene(server, self._maze)
        self._watch, self._pool = watch, pool
        self._points = grid_of(self._maze)
        self._dims: list[int] = []
        self._names: tuple[Any, ...] = ()
        self._loading: Future[Deployed] | None = None
        self._deployed: Deployed | None = None
        self._goal_values: Sequence[float] = ()
        self._report: AdaptationReport | None = None
        self._adapting: Future[Agent] | None = None
        self._stale = threading.Event()

    def close(self) -> None:
        """End the work that is under way."""
        self._stale.set()

    def refresh(self) -> None:
        """Draw what has changed."""
        state = self._watch.state
        if state is not None:
            self._scene.move_robot((state.position.x, state.position.y))
        self._load()
        self._draw_goal()
        self._draw_report()
        self._draw_expert()

    def _load(self) -> None:
        """Load policy and dataset, once their names are known and whenever those change."""
        policy = self._watch.policy
        names = tuple(policy[name] for name in ('checkpoint', 'dataset')) if policy else ()
        if names and names != self._names:
            self._names, self._deployed = names, None
            self._loading = self._pool.submit(load_deployed, *names)
        if self._loading is None or not self._loading.done() or self._watch.spec is None:
            return
        loading, self._loading = self._loading, None
        try:
            self._deployed = loading.result()
        except (OSError, ValueError) as error:
            self.fault = f'no data or policy to show: {error}'
            return
        self._goal_values, self._report = (), None  # to be drawn anew
        self._dims = list(self._watch.spec.position_dims)
        self._scene.show_data(self._deployed.dataset.observations[:, self._dims])

    def _draw_goal(self) -> None:
        goal = self._watch.goal
        if goal is None:
            return
        xy = (goal.position.x, goal.position.y)
        self._scene.show_goal(xy if goal.active else None, self._watch.tolerance_m)
        deployed = self._deployed
        if deployed is None or list(goal.goal) == list(self._goal_values):
            return
        self._goal_values = goal.goal
        self._scene.remove('after')
        if deployed.has_field:
            self._show_field('before', deployed.agent)

    def _draw_report(self) -> None:
        """Show what was retrieved, and take its gradient steps again for the expert's field."""
        report, goal, deployed = self._watch.report, self._watch.goal, self._deployed
        if report is self._report or deployed is None or goal is None or report is None:
            return
        if report.query_id != goal.query_id:
            return  # the goal is still under way to here, or has been replaced
        self._report = report
        segments = list(zip(report.segment_starts, report.segment_stops, strict=True))
        self._scene.show_retrieved(
            [deployed.dataset.observations[start:stop, self._dims] for start, stop in segments]
        )
        self._stale.set()
        self._stale = threading.Event()
        self._adapting = None
        if deployed.has_field and report.accepted:
            query = Query(to_array(goal.goal), goal.seed, segments, report.train_losses)
            config = _config(self._watch.policy, report.steps)
            self._adapting = self._pool.submit(
                expert_of, deployed, query, config, self._stale.is_set
            )

    def _draw_expert(self) -> None:
        if self._adapting is None or not self._adapting.done():
            return
        adapting, self._adapting = self._adapting, None
        try:
            self._show_field('after', adapting.result())
        except AdaptationCancelled:
            return
        except ValueError as error:
            self.fault = f'the adapted field is not shown: {error}'

    def _show_field(self, name: str, agent: Agent) -> None:
        color, height_m = {'before': (BEFORE, _BEFORE_M), 'after': (AFTER, _AFTER_M)}[name]
        actions = agent.act(self._points, np.array(self._goal_values))
        self._scene.show_field(name, color, self._points, actions, height_m)


def _config(policy: dict[str, Any], steps: int) -> TTTConfig:
    """The inner loop of the policy node."""
    return TTTConfig(
        steps=steps,
        lr=policy['adapt_lr'],
        batch_size=policy['adapt_batch_size'],
        **{
            name: policy[name]
            for name in ('early_stopping', 'test_fraction', 'actor_only', 'optimizer_state')
        },
    )
