"""The node that takes goals and decides when they are over."""

from typing import Any

from geometry_msgs.msg import PoseStamped
from metagcttt_core import TrajectoryDataset, TrajectoryFilter
from metagcttt_interfaces.msg import EpisodeEvent, GoalQuery, MazeState
import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sim_bridge import describe_environment
from std_msgs.msg import Header

from metagcttt.converters import to_array, to_floats, to_point, vector_fault
from metagcttt.deployment import dataset_path
from metagcttt.goals import Goal, goal_ending, GoalCatalog
from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import GOAL_NODE
from metagcttt.qos import COMMAND, EVENTS, LATCHED, state_profile

ENDING_KINDS = {'reached': EpisodeEvent.REACHED, 'timed out': EpisodeEvent.TIMED_OUT}


class GoalNode(Node):
    """Turns poses and task goals into numbered queries, one at a time, and ends them.

    A goal belongs to the episode in which it was accepted; a newer goal replaces it and a new
    episode voids it.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Load the maze's plan and the dataset.

        Args:
            kwargs: For `rclpy.node.Node`.

        Raises:
            FileNotFoundError: If the committed assets are asked for and missing.
            ValueError: If the environment is unknown or the dataset does not fit it.
        """
        super().__init__('goal_node', **kwargs)
        self._settings = ParameterSet(self, GOAL_NODE, is_configured=lambda: True)
        description = describe_environment(self._settings['environment'])
        self._spec = description.spec
        dataset = TrajectoryDataset.load(dataset_path(self._settings['dataset']))
        self._catalog = GoalCatalog(description, TrajectoryFilter(dataset))
        self._state: MazeState | None = None
        self._goal: Goal | None = None
        self._num_accepted = 0

        self._queries = self.create_publisher(GoalQuery, 'goal', LATCHED)
        self._events = self.create_publisher(EpisodeEvent, 'episode', EVENTS)
        profile = state_profile(self._settings['stepping'])
        self.create_subscription(MazeState, 'state', self._on_state, profile)
        self.create_subscription(PoseStamped, 'goal_pose', self._on_goal_pose, COMMAND)
        self.create_subscription(EpisodeEvent, 'episode', self._on_event, EVENTS)
        self.get_logger().info(f'goals in {self._spec.name}, completed from {dataset.source}')

    # --- goals come in -----------------------------------------------------------------------

    def _on_goal_pose(self, message: PoseStamped) -> None:
        x, y = message.pose.position.x, message.pose.position.y
        frame, state = self._settings['frame_id'], self._state
        if message.header.frame_id != frame:
            reason = f'the goal is in frame {message.header.frame_id!r}, goals are in {frame!r}'
        elif state is None:
            reason = 'no state of the simulator has arrived yet'
        elif state.terminated or state.truncated:
            reason = f'episode {state.episode_id} has ended: reset the simulator or set a task'
        else:
            reason = self._catalog.refusal(x, y)
        if reason or state is None:
            self._publish_event(EpisodeEvent.GOAL_REJECTED, (x, y), reason)
            return
        self._accept(
            self._catalog.complete(x, y),
            episode_id=state.episode_id,
            step=state.step,
            seed=self._settings['seed'],
            is_task=False,
        )

    def _on_event(self, message: EpisodeEvent) -> None:
        if message.kind != EpisodeEvent.STARTED:
            return
        self._void_unless(message.episode_id)
        if not message.goal:
            return
        goal = to_array(message.goal)
        reason = vector_fault("the task's goal", goal, self._spec.obs_dim)
        if reason:
            self._publish_event(EpisodeEvent.GOAL_REJECTED, (0.0, 0.0), reason)
            return
        self._accept(
            goal,
            episode_id=message.episode_id,
            step=message.step,
            seed=message.seed,
            is_task=True,
        )

    def _accept(
        self,
        observation: NDArray[np.float64],
        *,
        episode_id: int,
        step: int,
        seed: int,
        is_task: bool,
    ) -> None:
        self._num_accepted += 1
        self._goal = Goal(
            query_id=self._num_accepted,
            episode_id=episode_id,
            observation=observation,
            xy=self._catalog.position(observation),
            seed=seed,
            first_step=step,
            is_task=is_task,
        )
        self._publish_query(self._goal, active=True)
        self._publish_event(EpisodeEvent.GOAL_ACCEPTED, self._goal.xy, '', self._goal)

    # --- goals end ---------------------------------------------------------------------------

    def _on_state(self, message: MazeState) -> None:
        self._state = message
        if self._goal is not None and message.episode_id > self._goal.episode_id:
            self._void_unless(message.episode_id)
        if self._goal is None or message.episode_id != self._goal.episode_id:
            return
        ending = goal_ending(
            self._goal,
            xy=(message.position.x, message.position.y),
            step=message.step,
            ended=message.terminated or message.truncated,
            success=message.success,
            tolerance_m=self._settings['goal_tolerance_m'] or self._spec.goal_tolerance_m,
            max_steps=self._settings['max_steps'] or self._spec.max_episode_steps,
        )
        if ending is not None:
            how, reason = ending
            goal, self._goal = self._goal, None
            self._publish_query(goal, active=False)
            self._publish_event(ENDING_KINDS[how], goal.xy, reason, goal)

    def _void_unless(self, episode_id: int) -> None:
        """Drop a goal of another episode."""
        if self._goal is not None and self._goal.episode_id != episode_id:
            goal, self._goal = self._goal, None
            self._publish_query(goal, active=False)
            self.get_logger().info(f'goal {goal.query_id} is void: episode {episode_id} began')

    # --- what is published -------------------------------------------------------------------

    def _header(self) -> Header:
        return Header(stamp=self.get_clock().now().to_msg(), frame_id=self._settings['frame_id'])

    def _publish_query(self, goal: Goal, *, active: bool) -> None:
        self._queries.publish(
            GoalQuery(
                header=self._header(),
                query_id=goal.query_id,
                episode_id=goal.episode_id,
                active=active,
                goal=to_floats(goal.observation),
                position=to_point(goal.xy),
                seed=goal.seed,
            )
        )

    def _publish_event(
        self, kind: int, xy: tuple[float, float], reason: str, goal: Goal | None = None
    ) -> None:
        state = self._state
        episode_id = goal.episode_id if goal else state.episode_id if state else 0
        self._events.publish(
            EpisodeEvent(
                header=self._header(),
                kind=kind,
                episode_id=episode_id,
                query_id=goal.query_id if goal else 0,
                step=state.step if state and state.episode_id == episode_id else 0,
                reason=reason,
                position=to_point(xy),
            )
        )
        name = {
            EpisodeEvent.GOAL_ACCEPTED: 'accepted',
            EpisodeEvent.GOAL_REJECTED: 'rejected',
            EpisodeEvent.REACHED: 'reached',
            EpisodeEvent.TIMED_OUT: 'timed out',
        }[kind]
        number = f' {goal.query_id}' if goal else ''
        self.get_logger().info(
            f'goal{number} at ({xy[0]:.2f}, {xy[1]:.2f}) {name}{": " if reason else ""}{reason}'
        )
