"""The goal node."""

from collections.abc import Iterable
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from metagcttt_core import TrajectoryDataset, TrajectoryFilter
from metagcttt_core.config.assets import dataset_path
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent, MazeState, PolicyStatus
import numpy as np
from sim_bridge import describe_environment

from metagcttt.clocks import JumpFreeClock, STEADY
from metagcttt.conventions import ConventionalNode
from metagcttt.converters import to_array
from metagcttt.diagnostics import Diagnostics
from metagcttt.goal.goals import GoalCatalog, RobotState, Verdict
from metagcttt.goal.health import GoalMonitor
from metagcttt.goal.publishers import GoalPublishers
from metagcttt.goal.reach_goal_server import feedback_message, ReachGoalServer
from metagcttt.goal.tracker import Change, Ended, GoalRequest, GoalTracker, Ignored, Now, Rejected
from metagcttt.health import Health
from metagcttt.input_checks import vector_fault
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
from metagcttt.worlds import Moment

WATCHDOG_PERIOD_S = 0.1


class GoalNode(ConventionalNode):
    """Puts poses, action goals and task goals in force, as `GoalTracker` decides."""

    def __init__(self, **kwargs: Any) -> None:
        """Load the layout of the maze and the dataset.

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
        self._clock_without_jumps = JumpFreeClock(self)
        dataset = TrajectoryDataset.load(dataset_path(self._settings['dataset']))
        self._tracker = GoalTracker(
            GoalCatalog(description, TrajectoryFilter(dataset)),
            self._settings['frame_id'],
            self._now(),
            realtime=self._settings['stepping'] == 'realtime',
        )
        self._monitor = GoalMonitor()
        self._policy = PolicyStatus()

        self._goal_publishers = GoalPublishers(self, self._settings['frame_id'])
        profile = state_profile(self._settings['stepping'])
        if self._settings['stepping'] == 'lockstep':
            # The simulator waits for the policy, not for this node, which must see every step.
            profile = keep_several(profile, RECORDED_DEPTH)
        self.create_subscription(
            MazeState,
            'state',
            self._on_state,
            profile,
        )
        self.create_subscription(PoseStamped, 'goal_pose', self._on_goal_pose, COMMAND)
        self.create_subscription(
            EpisodeEvent,
            'episode',
            self._on_event,
            EVENTS,
        )
        self.create_subscription(PolicyStatus, 'policy_status', self._on_policy, LATCHED)
        self._reach_goal = ReachGoalServer(
            self,
            refusal=self._refusal,
            begin=lambda request: self._publish(
                self._tracker.accept(self._to_request(request), self._now())
            ),
            cancel=lambda: self._end(Verdict('CANCELED', 'canceled')),
        )
        self.create_timer(WATCHDOG_PERIOD_S, self._on_watchdog, clock=STEADY)
        self._diagnostics = Diagnostics(
            self, self._examine, self._settings['diagnostics_period_s']
        )
        self.get_logger().info(f'goals in {self._spec.name}, completed from {dataset.source}')

    def end_service(self) -> None:
        """End the goal in force before the node shuts down."""
        self._end(Verdict('SHUTDOWN', 'the goal node is shutting down'))

    def destroy_node(self) -> None:
        """Destroy the action server, then the node."""
        self._reach_goal.destroy()
        self._clock_without_jumps.close()
        super().destroy_node()

    # --- input -------------------------------------------------------------------------------

    def _to_request(self, message: ReachGoal.Goal) -> GoalRequest:
        point = message.pose.pose.position
        return GoalRequest(
            seed=self._settings['seed'],
            xy=(point.x, point.y),
            frame_id=message.pose.header.frame_id,
            observation=to_array(message.goal) if message.goal else None,
            episode_id=message.episode_id,
            max_steps=message.max_steps,
            request_id=message.request_id,
            world_id=message.world_id,
        )

    def _refusal(self, message: ReachGoal.Goal) -> Verdict | None:
        """The reason why an action goal cannot be served, which is published; None when it can."""
        request = self._to_request(message)
        refusal = self._tracker.refusal(request)
        if refusal is not None:
            self._publish([self._tracker.reject(request, refusal)])
        return refusal

    def _on_goal_pose(self, message: PoseStamped) -> None:
        request = self._to_request(ReachGoal.Goal(pose=message))
        self._publish(self._tracker.request(request, self._now()))

    def _on_event(self, message: EpisodeEvent, info: dict[str, int]) -> None:
        if message.kind != EpisodeEvent.STARTED:
            return
        task = None
        if message.goal:
            task = GoalRequest(
                seed=message.seed,
                observation=to_array(message.goal),
                episode_id=message.episode_id,
                is_task=True,
                world_id=message.world_id,
            )
        start = Moment(message.world_id, message.episode_id)
        published_ns = info['source_timestamp']
        self._publish(self._tracker.on_episode(start, published_ns, self._now(), task))

    def _on_state(self, message: MazeState, info: dict[str, int]) -> None:
        xy = (message.position.x, message.position.y)
        fault = vector_fault(
            'the state', to_array(message.observation), self._spec.obs_dim
        ) or vector_fault("the state's position", np.array(xy), 2)
        self._monitor.saw_state(fault)
        if fault:
            return
        state = RobotState(
            episode_id=message.episode_id,
            step=message.step,
            xy=xy,
            ended=message.terminated or message.truncated,
            success=message.success,
            world_id=message.world_id,
        )
        self._publish(
            self._tracker.on_state(
                state,
                info['source_timestamp'],
                self._now(),
                tolerance_m=self._settings['goal_tolerance_m'] or self._spec.goal_tolerance_m,
                max_steps=self._settings['max_steps'] or self._spec.max_episode_steps,
            )
        )
        self._send_feedback()

    def _on_policy(self, message: PolicyStatus) -> None:
        self._policy = message
        self._monitor.saw_policy()
        self._tracker.on_partner(self._now())
        self._send_feedback()

    def _on_watchdog(self) -> None:
        now = self._now()
        if self._tracker.goal is not None:
            self._goal_publishers.repeat_goal(now.steady_s)
            self._send_feedback()
        self._publish(
            self._tracker.on_time(
                now,
                has_source=bool(self.count_publishers('state')),
                timeout_s=self._settings['state_timeout_s'],
                partner_timeout_s=self._settings['partner_timeout_s'],
            )
        )

    def _now(self) -> Now:
        return Now(time.monotonic(), self._clock_without_jumps.now_s())

    # --- output ------------------------------------------------------------------------------

    def _publish(self, changes: Iterable[Change]) -> None:
        for change in changes:
            if isinstance(change, Ignored):
                self._monitor.ignored(change.reason)
            self._goal_publishers.publish(change, self._settings['goal_lease_s'])
            if isinstance(change, Ended | Rejected):
                self._monitor.counts[change.verdict.error] += 1
            if isinstance(change, Ended):
                self._reach_goal.finish(change)

    def _end(self, verdict: Verdict) -> None:
        self._publish(self._tracker.end(verdict, self._now()))

    def _send_feedback(self) -> None:
        goal = self._tracker.goal
        if goal is not None:
            self._reach_goal.report(feedback_message(goal, self._tracker.state, self._policy))

    def _examine(self) -> Health:
        return self._monitor.examine(
            self._tracker.goal,
            has_source=bool(self.count_publishers('state')),
            policy_timeout_s=self._settings['policy_timeout_s'],
        )
