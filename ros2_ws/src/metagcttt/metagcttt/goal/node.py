"""The node that takes goals and decides when they are over."""

import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from metagcttt_core import TrajectoryDataset, TrajectoryFilter
from metagcttt_core.config.assets import dataset_path
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent, MazeState, PolicyStatus
import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sim_bridge import describe_environment

from metagcttt.converters import feedback_message, to_array
from metagcttt.diagnostics import Diagnostics
from metagcttt.goal.goals import Goal, goal_ending, GoalCatalog, Verdict
from metagcttt.goal.health import GoalMonitor
from metagcttt.goal.publishers import GoalPublishers
from metagcttt.goal.reach_goal_server import ReachGoalServer
from metagcttt.health import Health
from metagcttt.input_checks import StateOrder, vector_fault
from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import GOAL_NODE
from metagcttt.qos import (
    COMMAND,
    EVENTS,
    keep_several,
    LATCHED,
    RECORDED_DEPTH,
    state_profile,
)

WATCH_PERIOD_S = 0.1


class GoalNode(Node):
    """Turns poses, action goals and task goals into numbered queries, one at a time.

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
        self._state_published_ns = 0
        self._note_time()
        self._source_seen_s = time.monotonic()
        self._order = StateOrder()
        self._monitor = GoalMonitor()
        self._policy = PolicyStatus()
        self._goal: Goal | None = None
        self._num_accepted = 0

        self._say = GoalPublishers(self, self._settings['frame_id'])
        profile = state_profile(self._settings['stepping'])
        if self._settings['stepping'] == 'lockstep':
            # The world waits for the policy, not for this node, which has to see every step.
            profile = keep_several(profile, RECORDED_DEPTH)
        self.create_subscription(
            MazeState,
            'state',
            self._on_state,  # type: ignore[arg-type] # rclpy gives it the info as well
            profile,
        )
        self.create_subscription(PoseStamped, 'goal_pose', self._on_goal_pose, COMMAND)
        self.create_subscription(
            EpisodeEvent,
            'episode',
            self._on_event,  # type: ignore[arg-type] # here too
            EVENTS,
        )
        self.create_subscription(PolicyStatus, 'policy_status', self._on_policy, LATCHED)
        self._reach_goal = ReachGoalServer(
            self,
            is_acceptable=self._is_acceptable,
            begin=self._begin,
            cancel=lambda: self._end(Verdict('CANCELED', 'canceled')),
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(WATCH_PERIOD_S, self._watch, clock=steady)
        self._diagnostics = Diagnostics(
            self, self._examine, self._settings['diagnostics_period_s']
        )
        self.get_logger().info(f'goals in {self._spec.name}, completed from {dataset.source}')

    def end_service(self) -> None:
        """Stop the robot and tell whoever waits for it; the node is about to go down."""
        self._end(Verdict('SHUTDOWN', 'the goal node is going down'))

    def destroy_node(self) -> None:
        """Withdraw the action, then destroy the node."""
        self._reach_goal.destroy()
        super().destroy_node()

    # --- goals come in -----------------------------------------------------------------------

    def _on_goal_pose(self, message: PoseStamped) -> None:
        request = ReachGoal.Goal(pose=message)
        if self._is_acceptable(request):
            self._begin(request)

    def _is_acceptable(self, request: ReachGoal.Goal) -> bool:
        """Whether to take a goal; publishes why not."""
        refusal = self._refusal(request)
        if refusal is not None:
            point = request.pose.pose.position
            self._monitor.counts[refusal.error] += 1
            self._say.rejected(refusal, (point.x, point.y), self._state, request.request_id)
        return refusal is None

    def _refusal(self, request: ReachGoal.Goal) -> Verdict | None:
        frame, state = self._settings['frame_id'], self._state
        given_frame = request.pose.header.frame_id
        if given_frame != frame and not request.goal:
            reason = f'the goal is in frame {given_frame!r}, goals are in {frame!r}'
            return Verdict('WRONG_FRAME', reason)
        if state is None:
            if not request.episode_id:
                return Verdict('NO_STATE', 'no state of the simulator has arrived yet')
        elif request.episode_id and request.episode_id < state.episode_id:
            reason = f'episode {request.episode_id} is over, {state.episode_id} is the newest'
            return Verdict('EPISODE_OVER', reason)
        elif request.episode_id <= state.episode_id and (state.terminated or state.truncated):
            reason = f'episode {state.episode_id} has ended: reset the simulator or set a task'
            return Verdict('EPISODE_OVER', reason)
        if request.goal:
            return self._catalog.observation_refusal(to_array(request.goal))
        point = request.pose.pose.position
        return self._catalog.refusal(point.x, point.y)

    def _begin(self, request: ReachGoal.Goal) -> None:
        """Take up a goal that is acceptable."""
        self._expect_episode(request.episode_id)
        state, point = self._state, request.pose.pose.position
        assert state is not None, 'checked by _refusal'
        if request.goal:
            observation = to_array(request.goal)
        else:
            observation = self._catalog.complete(point.x, point.y)
        self._accept(
            observation,
            episode_id=state.episode_id,
            step=state.step,
            seed=self._settings['seed'],
            is_task=False,
            max_steps=request.max_steps,
            request_id=request.request_id,
        )

    def _on_event(self, message: EpisodeEvent, info: dict[str, int]) -> None:
        if message.kind != EpisodeEvent.STARTED:
            return
        if self._state is not None and message.episode_id < self._state.episode_id:
            # Not of a simulator that began anew, but what this one said before: it is latched.
            if info['source_timestamp'] < self._state_published_ns:
                return
        self._void_unless(message.episode_id)
        self._order = StateOrder()
        self._expect_episode(message.episode_id)
        if not message.goal:
            return
        goal = to_array(message.goal)
        refusal = self._catalog.observation_refusal(goal)
        if refusal is not None:
            self._say.rejected(refusal, (0.0, 0.0), self._state)
            return
        self._accept(
            goal,
            episode_id=message.episode_id,
            step=message.step,
            seed=message.seed,
            is_task=True,
        )

    def _expect_episode(self, episode_id: int) -> None:
        """Turn to a newer episode whose first state is on the way."""
        if episode_id > (self._state.episode_id if self._state else 0):
            self._void_unless(episode_id)
            self._state = MazeState(episode_id=episode_id)
            self._note_time()

    def _note_time(self) -> None:
        """Begin to wait for the next state, by both clocks: the node's may stand still."""
        self._state_time = self.get_clock().now()
        self._state_time_s = time.monotonic()

    def _accept(
        self,
        observation: NDArray[np.float64],
        *,
        episode_id: int,
        step: int,
        seed: int,
        is_task: bool,
        max_steps: int = 0,
        request_id: str = '',
    ) -> None:
        self._num_accepted += 1
        number = self._num_accepted
        self._end(Verdict('PREEMPTED', f'goal {number} took its place'), replaced=True)
        self._goal = Goal(
            query_id=number,
            episode_id=episode_id,
            observation=observation,
            xy=self._catalog.position(observation),
            seed=seed,
            first_step=step,
            is_task=is_task,
            max_steps=max_steps,
            request_id=request_id,
            accepted_ns=self.get_clock().now().nanoseconds,
        )
        self._say.query(self._goal, active=True, lease_s=self._settings['goal_lease_s'])
        self._say.accepted(self._goal)

    # --- goals go on and end -----------------------------------------------------------------

    def _on_state(self, message: MazeState, info: dict[str, int]) -> None:
        xy = (message.position.x, message.position.y)
        fault = vector_fault('the state', to_array(message.observation), self._spec.obs_dim)
        fault = fault or vector_fault("the state's position", np.array(xy), 2)
        if self._settings['stepping'] == 'realtime':
            fault = fault or self._order.refusal(message.episode_id, message.step)
        self._monitor.saw_state(fault)
        if fault:
            return
        if self._goal is not None and message.episode_id < self._goal.episode_id:
            return  # the goal's own episode is on the way
        self._state = message
        self._state_published_ns = info['source_timestamp']
        self._note_time()
        if self._goal is not None and message.episode_id > self._goal.episode_id:
            self._void_unless(message.episode_id)
        if self._goal is None or message.episode_id != self._goal.episode_id:
            return
        ending = goal_ending(
            self._goal,
            xy=xy,
            step=message.step,
            ended=message.terminated or message.truncated,
            success=message.success,
            tolerance_m=self._settings['goal_tolerance_m'] or self._spec.goal_tolerance_m,
            max_steps=self._goal.max_steps
            or self._settings['max_steps']
            or self._spec.max_episode_steps,
        )
        if ending is None:
            self._report_progress()
        else:
            self._end(ending)

    def _on_policy(self, message: PolicyStatus) -> None:
        self._policy = message
        self._monitor.saw_policy()
        self._report_progress()

    def _report_progress(self) -> None:
        if self._goal is not None and self._state is not None:
            self._reach_goal.report(feedback_message(self._goal, self._state, self._policy))

    def _watch(self) -> None:
        """Keep the goal in force up; give it up when the simulator is silent.

        In lockstep the simulator may be silent for long, so there it is given up when it is gone.
        """
        now_s = time.monotonic()
        if self._goal is not None:
            self._say.keep_up(now_s)
            self._report_progress()
        awaited = (
            self._goal is not None and self._state is not None and not self._state.observation
        )
        if self.count_publishers('state') and not awaited:
            self._source_seen_s = now_s
        age_s = now_s - self._source_seen_s
        if self._settings['stepping'] == 'realtime':
            silence = self.get_clock().now() - self._state_time
            age_s = max(age_s, silence.nanoseconds / 1e9, now_s - self._state_time_s)
        if self._goal is not None and age_s > self._settings['state_timeout_s']:
            reason = f'no state of episode {self._goal.episode_id} for {age_s:.1f} s'
            self._end(Verdict('STATE_LOST', reason))

    def _void_unless(self, episode_id: int) -> None:
        """Drop a goal of another episode."""
        if self._goal is not None and self._goal.episode_id != episode_id:
            self._end(Verdict('NEW_EPISODE', f'episode {episode_id} began'))

    def _end(self, verdict: Verdict, *, replaced: bool = False) -> None:
        """End the goal in force, if any, and say so; a newer query follows when `replaced`."""
        goal, self._goal = self._goal, None
        if goal is None:
            return
        if not replaced:
            self._say.query(goal, active=False)
        step = goal.first_step
        if self._state is not None and self._state.episode_id == goal.episode_id:
            step = max(step, self._state.step)
        self._say.ended(goal, verdict, step)
        self._monitor.counts[verdict.error] += 1
        seconds = (self.get_clock().now().nanoseconds - goal.accepted_ns) / 1e9
        self._reach_goal.finish(verdict, step - goal.first_step, seconds)

    def _examine(self) -> Health:
        return self._monitor.examine(
            self._goal,
            has_source=bool(self.count_publishers('state')),
            policy_timeout_s=self._settings['policy_timeout_s'],
        )
