"""Accepted goals, the check of a goal against a maze, and the end of a goal."""

from dataclasses import dataclass, field
import math
from typing import Protocol, TYPE_CHECKING

from metagcttt_core import TrajectoryFilter
import numpy as np
from numpy.typing import NDArray
from sim_bridge import MazeDescription

from metagcttt.goal.target import miss, Term
from metagcttt.goal.verdict import Verdict
from metagcttt.goal_in_force import Goal
from metagcttt.input_checks import vector_fault
from metagcttt.worlds import Moment

if TYPE_CHECKING:
    from metagcttt.goal.tracker import GoalRequest


@dataclass(frozen=True)
class Resolved:
    """What a request comes to.

    Attributes:
        observation: The complete goal observation, shape (obs_dim,), float64.
        xy: The position in it, metres; NaN for a robot without one.
        terms: What has to be so at the goal; empty: the position, within the node's tolerance.
        timeout_s: Time that it may take by default, seconds; 0: as long as it likes.
    """

    observation: NDArray[np.float64]
    xy: tuple[float, float]
    terms: tuple[Term, ...] = ()
    timeout_s: float = 0.0


class Catalog(Protocol):
    """Decides what goals there are."""

    @property
    def frame_id(self) -> str:
        """Frame of goal poses."""

    def resolve(self, request: 'GoalRequest') -> Resolved | Verdict:
        """The goal that a request asks for, or why there is none."""


@dataclass(frozen=True)
class AcceptedGoal(Goal):
    """A goal with what decides about its end and what its sender is told.

    Attributes:
        first_step: Control step of the episode from which its steps count.
        is_task: Whether it is the goal of the episode's own task.
        max_steps: Control steps that it may take; 0 for the goal node's own limit.
        request_id: Name that the sender of an action goal gave it.
        accepted_s: Time of acceptance, seconds of the goal node's clock.
        terms: See `Resolved`.
        timeout_s: Time that it may take, seconds; 0: as long as it likes.
    """

    first_step: int = 0
    is_task: bool = False
    max_steps: int = 0
    request_id: str = ''
    accepted_s: float = 0.0
    terms: tuple[Term, ...] = ()
    timeout_s: float = 0.0


@dataclass(frozen=True)
class RobotState:
    """A state of the robot in an episode, as far as it decides about goals.

    Attributes:
        episode_id: Its episode.
        step: Its control step.
        xy: The robot's position in metres.
        ended: Whether the episode ended with this state.
        success: Whether the robot is at the goal of the episode's task, as the simulator judges.
        world_id: Its world; 0 when it names none.
        observation: Shape (obs_dim,); empty where only the position decides.
    """

    episode_id: int
    step: int
    xy: tuple[float, float]
    ended: bool = False
    success: bool = False
    world_id: int = 0
    observation: NDArray[np.float64] = field(default_factory=lambda: np.empty(0), compare=False)

    @property
    def moment(self) -> Moment:
        """Its place in time."""
        return Moment(self.world_id, self.episode_id, self.step)


class GoalCatalog:
    """Checks positions against a maze and completes them to goal observations."""

    def __init__(
        self,
        description: MazeDescription,
        trajectory_filter: TrajectoryFilter,
        frame_id: str = 'map',
    ) -> None:
        """Create the catalog of a maze and a dataset recorded in it.

        Args:
            description: The maze.
            trajectory_filter: Finds states of the dataset.
            frame_id: Frame of the maze.

        Raises:
            ValueError: If the dataset has other observations than the maze.
        """
        data = trajectory_filter.dataset
        if data.obs_dim != description.spec.obs_dim:
            raise ValueError(
                f'the dataset {data.source or ""} has observations of {data.obs_dim} values, '
                f'{description.spec.name} of {description.spec.obs_dim}'
            )
        self.frame_id = frame_id
        self._maze = description.maze
        self._position_dims = list(description.spec.position_dims)
        self._filter = trajectory_filter

    def resolve(self, request: 'GoalRequest') -> Resolved | Verdict:
        """The goal that a request asks for, or why there is none."""
        if request.observation is not None:
            observation = request.observation
            refusal = self.observation_refusal(observation)
        elif request.names:
            reason = 'a maze takes goals by position or as a whole observation, not by names'
            return Verdict('UNKNOWN_VALUE', reason)
        elif request.frame_id != self.frame_id:
            reason = f'the goal is in frame {request.frame_id!r}, goals are in {self.frame_id!r}'
            return Verdict('WRONG_FRAME', reason)
        else:
            refusal = self.refusal(*request.xy)
            observation = self.complete(*request.xy) if refusal is None else np.empty(0)
        return refusal or Resolved(observation, self.position(observation))

    def refusal(self, x: float, y: float) -> Verdict | None:
        """The reason why the position (x, y), in metres, cannot be a goal; None when it can."""
        if not (math.isfinite(x) and math.isfinite(y)):
            return Verdict('NOT_FINITE', f'the position ({x}, {y}) is not finite')
        if not self._maze.contains(x, y):
            xmin, xmax, ymin, ymax = self._maze.extent
            return Verdict(
                'OUTSIDE_MAZE',
                f'({x:.2f}, {y:.2f}) is outside the maze, which spans x {xmin:g} to {xmax:g} '
                f'and y {ymin:g} to {ymax:g} metres',
            )
        if not self._maze.is_free(x, y):
            reason = f'({x:.2f}, {y:.2f}) is in a wall, cell {self._maze.cell(x, y)}'
            return Verdict('IN_WALL', reason)
        return None

    def observation_refusal(self, observation: NDArray[np.float64]) -> Verdict | None:
        """The reason why a goal observation, shape (n,), cannot be a goal; None when it can."""
        fault = vector_fault('the goal', observation, self._filter.dataset.obs_dim)
        if fault:
            wrong_size = observation.shape != (self._filter.dataset.obs_dim,)
            return Verdict('WRONG_SIZE' if wrong_size else 'NOT_FINITE', fault)
        return self.refusal(*self.position(observation))

    def complete(self, x: float, y: float) -> NDArray[np.float64]:
        """A goal observation at the position (x, y), in metres, shape (obs_dim,), float64.

        The other values are those of the dataset's state nearest to the position.
        """
        row = self._filter.nearest_row(np.array((x, y)))
        observation = np.array(self._filter.dataset.states(row), dtype=np.float64)
        observation[self._position_dims] = (x, y)
        return observation

    def position(self, observation: NDArray[np.float64]) -> tuple[float, float]:
        """The position (x, y), in metres, in an observation of shape (obs_dim,)."""
        x, y = observation[self._position_dims]
        return float(x), float(y)


def goal_ending(
    goal: AcceptedGoal,
    state: RobotState,
    *,
    tolerance_m: float,
    max_steps: int,
    seconds: float = 0.0,
) -> Verdict | None:
    """The ending of a goal in a state of its episode; None while it is under way.

    Args:
        goal: The goal.
        state: The state.
        tolerance_m: Distance within which a goal without terms is reached, metres.
        max_steps: Control steps that a goal may take unless it says otherwise; 0: any number.
        seconds: Time since its acceptance.

    Returns:
        The verdict, with error `NONE` when the goal was reached.
    """
    steps = state.step - goal.first_step
    if goal.terms:
        missed = miss(goal.terms, state.observation, goal.observation)
        is_reached, where = not missed, missed or 'within every tolerance'
    else:
        distance_m = math.dist(state.xy, goal.xy)
        is_reached = distance_m <= tolerance_m or (goal.is_task and state.success)
        where = f'{distance_m:.2f} m from the goal'
    if is_reached:
        return Verdict('NONE', f'after {steps} steps, {where}')
    limit = goal.max_steps or max_steps
    if limit and steps >= limit:
        return Verdict('TIMED_OUT', f'not reached in {steps} steps, {where}')
    if goal.timeout_s and seconds >= goal.timeout_s:
        return Verdict('TIMED_OUT', f'not reached in {seconds:.1f} s, {where}')
    if state.ended:
        return Verdict('EPISODE_ENDED', f'the episode ended {where}')
    return None
