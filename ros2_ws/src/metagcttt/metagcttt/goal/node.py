"""The goal node."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from metagcttt_core import TrajectoryDataset, TrajectoryFilter
from metagcttt_core.config.assets import dataset_path
from metagcttt_core.robot import Contract, load_contract
from metagcttt_core.robot.contract import GoalMap
from metagcttt_interfaces.action import ReachGoal
from metagcttt_interfaces.msg import EpisodeEvent, MazeState, NamedGoal, PolicyStatus
from nav_msgs.msg import OccupancyGrid
import numpy as np
from sim_bridge import describe_environment

from metagcttt.clocks import JumpFreeClock, STEADY
from metagcttt.conventions import ConventionalNode
from metagcttt.converters import to_array
from metagcttt.diagnostics import Diagnostics
from metagcttt.goal.goals import Catalog, GoalCatalog, RobotState
from metagcttt.goal.health import GoalMonitor
from metagcttt.goal.obstacles import Obstacles
from metagcttt.goal.publishers import GoalPublishers
from metagcttt.goal.reach_goal_server import feedback_message, ReachGoalServer
from metagcttt.goal.robot_goals import RobotGoals
from metagcttt.goal.tracker import Change, Ended, GoalRequest, GoalTracker, Ignored, Now, Rejected
from metagcttt.goal.verdict import Verdict
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
        self._robot: Contract | None = None
        if self._settings['contract']:
            self._robot = load_contract(Path(self._settings['contract']).expanduser())
        self._clock_without_jumps = JumpFreeClock(self)
        dataset = TrajectoryDataset.load(dataset_path(self._settings['dataset']))
        catalog = self._catalog(dataset)
        self._tracker = GoalTracker(
            catalog,
            self._now(),
            realtime=self._settings['stepping'] == 'realtime',
        )
        self._monitor = GoalMonitor()
        self._policy = PolicyStatus()

        self._goal_publishers = GoalPublishers(self, catalog.frame_id)
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
        self.create_subscription(NamedGoal, 'goal_values', self._on_goal_values, COMMAND)
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
        self.get_logger().info(f'goals in {self._what}, completed from {dataset.source}')

    def _catalog(self, dataset: TrajectoryDataset) -> Catalog:
        """What decides about goals: a robot's contract, or a maze."""
        if self._robot is None:
            description = describe_environment(self._settings['environment'])
            spec = description.spec
            self._what, self._obs_dim, self._fingerprint = spec.name, spec.obs_dim, ''
            self._tolerance_m, self._max_steps = spec.goal_tolerance_m, spec.max_episode_steps
            frame_id = self._settings['frame_id']
            return GoalCatalog(description, TrajectoryFilter(dataset), frame_id)
        goals = RobotGoals(self._robot, dataset)
        self._what, self._obs_dim = f'the frame {goals.frame_id!r}', self._robot.obs_dim
        self._fingerprint = self._robot.identity['fingerprint']
        self._tolerance_m, self._max_steps = 0.0, 0  # the contract's tolerances and time
        section = self._robot.goal
        if section is not None and section.map is not None:
            self.create_subscription(
                OccupancyGrid,
                section.map.topic,
                partial(self._on_map, goals, section.map),
                LATCHED,
            )
        return goals

    def _on_map(self, goals: RobotGoals, settings: GoalMap, message: OccupancyGrid) -> None:
        try:
            goals.obstacles = Obstacles.of(message, settings)
        except ValueError as error:
            self._monitor.ignored(str(error))
            self.get_logger().error(f'the map is ignored: {error}')

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
        point, turn = message.pose.pose.position, message.pose.pose.orientation
        return GoalRequest(
            seed=self._settings['seed'],
            xy=(point.x, point.y),
            quaternion=(turn.x, turn.y, turn.z, turn.w),
            names=tuple(message.named.names),
            values=tuple(message.named.values),
            tolerances=tuple(message.named.tolerances),
            timeout_s=message.timeout_s,
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

    def _on_goal_values(self, message: NamedGoal) -> None:
        request = self._to_request(ReachGoal.Goal(named=message))
        if not request.names:
            refusal = Verdict('WRONG_SIZE', 'a goal by named values without names')
            self._publish([self._tracker.reject(request, refusal)])
            return
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
        observation = to_array(message.observation)
        fault = self._contract_fault(message.contract) or (
            vector_fault('the state', observation, self._obs_dim)
            or vector_fault("the state's position", np.array(xy), 2)
        )
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
            observation=observation,
        )
        self._publish(
            self._tracker.on_state(
                state,
                info['source_timestamp'],
                self._now(),
                tolerance_m=self._settings['goal_tolerance_m'] or self._tolerance_m,
                max_steps=self._settings['max_steps'] or self._max_steps,
            )
        )
        self._send_feedback()

    def _contract_fault(self, fingerprint: str) -> str:
        """Why a state of that contract is none of this robot; empty if it is."""
        if not fingerprint or not self._fingerprint or fingerprint == self._fingerprint:
            return ''
        return f'the state is of contract {fingerprint}, goals are of {self._fingerprint}'

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
