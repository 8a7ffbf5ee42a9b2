"""The scene of one robot, kept up with what is known of it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
import threading
from typing import Any, Protocol, TYPE_CHECKING

from metagcttt.converters import to_array
from metagcttt_core import Agent, TTTConfig
from metagcttt_core.adaptation import AdaptationCancelled
import numpy as np
from sim_bridge import MazeMap
import viser

from metagcttt_tools.live.fields import Deployed, expert_of, grid_of, load_deployed, Query
from metagcttt_tools.live.robots import Robot
from metagcttt_tools.live.scene import AFTER, BEFORE, MazeScene
from metagcttt_tools.recordings.goal_views import maze_of

if TYPE_CHECKING:
    from metagcttt_tools.live.body import Body

_BEFORE_M, _AFTER_M = 0.15, 0.3  # heights of the fields
_OPEN_FLOOR_CELLS = 20  # of a metre each


class Seen(Protocol):
    """What is known of a robot: `Watch` of one in a graph, `Replay` of one in a recording."""

    grid: Any
    state: Any
    goal: Any
    report: Any
    policy: dict[str, Any]
    robot: Robot | None


def _body_of(environment: str) -> Body:
    from metagcttt_tools.live.body import Body  # needs MuJoCo, which the machine may lack

    return Body(environment)


def floor_of(seen: Seen) -> MazeMap:
    """The map or, where there is none, an open floor around the robot."""
    if seen.grid is not None:
        return maze_of(seen.grid)
    x, y = seen.state.position.x, seen.state.position.y
    half = _OPEN_FLOOR_CELLS // 2
    free = np.zeros((_OPEN_FLOOR_CELLS, _OPEN_FLOOR_CELLS), dtype=bool)
    return MazeMap(walls=free, unit_m=1.0, origin_xy=(round(x) - half, round(y) - half))


class Picture:
    """Draws what is known of a robot on one map; slow work is done in a thread of `pool`.

    Attributes:
        grid: The map it was made for; None for an open floor.
        maze: That map, or the open floor.
        fault: Why something is not shown, in words; empty when there is nothing new to say.
    """

    def __init__(self, server: viser.ViserServer, seen: Seen, pool: ThreadPoolExecutor) -> None:
        """Build the maze.

        Args:
            server: Whose scene it is.
            seen: What is known, a map or a state at least.
            pool: For loading and adapting.
        """
        self.grid, self.fault = seen.grid, ''
        self.maze = floor_of(seen)
        self._scene = MazeScene(server, self.maze)
        self._seen, self._pool = seen, pool
        self._points = grid_of(self.maze)
        self._dims: list[int] = []
        self._names: tuple[Any, ...] = ()
        self._loading: Future[Deployed] | None = None
        self._deployed: Deployed | None = None
        self._goal_values: Sequence[float] = ()
        self._report: Any = None
        self._adapting: Future[Agent] | None = None
        self._stale = threading.Event()
        self._environment = ''
        self._building: Future[Body] | None = None
        self._body: Body | None = None
        self._posed: Any = None

    def close(self) -> None:
        """End the work that is under way."""
        self._stale.set()

    def refresh(self) -> None:
        """Draw what has changed."""
        self._draw_robot()
        self._load()
        self._draw_goal()
        self._draw_report()
        self._draw_expert()

    def _draw_robot(self) -> None:
        state, robot = self._seen.state, self._seen.robot or Robot()
        if robot.environment != self._environment:
            self._environment = robot.environment
            self._building = self._pool.submit(_body_of, robot.environment)
        if self._building is not None and self._building.done():
            building, self._building = self._building, None
            try:
                self._body = building.result()
                self._scene.add_body(self._body)
            except ValueError:
                pass  # a point, which is drawn as one
            except ImportError as error:
                self.fault = f'the robot is drawn as a ball: {error}'
        if state is None or state is self._posed:
            return
        self._posed = state
        heading = [float(state.observation[dim]) for dim in robot.heading_dims]
        xy = (state.position.x, state.position.y)
        self._scene.move_robot(xy, (heading[0], heading[1]) if heading else None)
        if self._body is not None:
            self._scene.pose(self._body.pose(np.asarray(state.observation)))

    def _load(self) -> None:
        """Load policy and dataset, once their names are known and whenever those change."""
        policy = self._seen.policy
        names = tuple(policy[name] for name in ('checkpoint', 'dataset')) if policy else ()
        if names and names != self._names:
            self._names, self._deployed = names, None
            self._loading = self._pool.submit(load_deployed, *names)
        if self._loading is None or not self._loading.done() or self._seen.robot is None:
            return
        loading, self._loading = self._loading, None
        try:
            self._deployed = loading.result()
        except (OSError, ValueError) as error:
            self.fault = f'no data or policy to show: {error}'
            return
        self._goal_values, self._report = (), None  # to be drawn anew
        self._dims = list(self._seen.robot.position_dims)
        state, obs_dim = self._seen.state, self._deployed.dataset.obs_dim
        if state is not None and len(state.observation) != obs_dim:
            self.fault = f'the data are of another robot: {obs_dim} values a state'
        elif len(self._dims) != 2:
            self.fault = 'the data have no position to be shown at'
        if self.fault:
            self._deployed = None
            return
        self._scene.show_data(self._deployed.dataset.observations[:, self._dims])

    def _draw_goal(self) -> None:
        goal, robot = self._seen.goal, self._seen.robot or Robot()
        if goal is None:
            self._scene.show_goal(None, robot.tolerance_m)
            return
        xy = (goal.position.x, goal.position.y)
        self._scene.show_goal(xy if goal.active else None, robot.tolerance_m)
        deployed = self._deployed
        if deployed is None or list(goal.goal) == list(self._goal_values):
            return
        self._goal_values = goal.goal
        self._scene.remove('after')
        if deployed.has_field:
            self._show_field('before', deployed.agent)

    def _draw_report(self) -> None:
        """Show what was retrieved, and take its gradient steps again for the expert's field."""
        report, goal, deployed = self._seen.report, self._seen.goal, self._deployed
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
            config = _config(self._seen.policy, report.steps)
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


_LOOP_SETTINGS = ('early_stopping', 'test_fraction', 'guard', 'actor_only', 'optimizer_state')


def _config(policy: dict[str, Any], steps: int) -> TTTConfig:
    """The inner loop of the policy node."""
    return TTTConfig(
        steps=steps,
        lr=policy['adapt_lr'],
        batch_size=policy['adapt_batch_size'],
        **{name: policy[name] for name in _LOOP_SETTINGS},
    )
