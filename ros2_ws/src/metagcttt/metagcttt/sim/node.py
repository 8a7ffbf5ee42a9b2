"""The simulator bridge node."""

import math
import secrets
import time
from typing import Any

from metagcttt_interfaces.msg import ActionCommand, EpisodeEvent, MazeState
from metagcttt_interfaces.srv import SetTask
from nav_msgs.msg import OccupancyGrid
import numpy as np
from numpy.typing import NDArray
from rclpy.parameter import Parameter
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock as ClockMessage
from sim_bridge import make_simulator, StepResult
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from metagcttt.clocks import STEADY
from metagcttt.conventions import ConventionalNode
from metagcttt.converters import (
    occupancy_grid,
    state_message,
    to_array,
    to_floats,
    to_point,
    to_time,
)
from metagcttt.diagnostics import Diagnostics
from metagcttt.health import Health
from metagcttt.input_checks import vector_fault
from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import SIM_BRIDGE_NODE
from metagcttt.qos import (
    COMMAND,
    EVENTS,
    keep_several,
    LATCHED,
    SENSOR,
    state_offer,
)
from metagcttt.sim.health import SimMonitor
from metagcttt.sim.pacing import Pacer

HEARTBEAT_S = 0.1
LOCKSTEP_HEARTBEAT_S = 1.0


class SimBridgeNode(ConventionalNode):
    """Steps one simulator with the actions received and publishes its states.

    In `realtime` it steps on its own, with the newest action or, when that has timed out, with
    zero. In `lockstep` it publishes a state and waits for the action for that state. While more
    than one node sends actions, it applies zero instead. After the end of a task episode, or while
    paused, nothing moves until the next reset or except by the service `step`. In realtime the
    last state is repeated while paused or stepping slowly, so that the simulator is not taken for
    dead. In lockstep it is repeated too, once a second, for a partner that lost it or joined late.

    Every state names the world: a number drawn at random when the node starts.

    The header of a state carries simulated time, which starts at 0 with the node and never goes
    back; `/clock` carries the same.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Load the simulator and start an episode without a task.

        Args:
            kwargs: For `rclpy.node.Node`.

        Raises:
            ValueError: If the environment is unknown, or its robot has no standing start.
        """
        super().__init__('sim_bridge_node', **kwargs)
        self._settings = ParameterSet(self, SIM_BRIDGE_NODE, is_configured=lambda: True)
        self._monitor = SimMonitor()
        self._simulator = make_simulator(
            self._settings['environment'], standing=self._settings['standing']
        )
        spec = self._simulator.spec
        self._lockstep = self._settings['stepping'] == 'lockstep'
        self._period_ns = round(spec.control_period_s * 1e9)
        self._time_ns = 0
        self._world_id = secrets.randbits(64) or 1  # 0 stands for none
        self._episode_id = 0
        self._step = 0
        self._last = StepResult(np.zeros(spec.obs_dim), False, False, False)
        self._action = np.zeros(spec.act_dim)
        self._action_time_ns = 0
        self._paused = bool(self._settings['start_paused'])
        self._awaiting: NDArray[np.float64] | None = None  # lockstep: received while paused

        offer = state_offer(self._settings['stepping'])
        self._states = self.create_publisher(MazeState, 'state', offer)
        self._events = self.create_publisher(EpisodeEvent, 'episode', EVENTS)
        self._map = self.create_publisher(OccupancyGrid, 'map', LATCHED)
        self._clock_messages = None
        if self._settings['publish_clock']:
            self._clock_messages = self.create_publisher(ClockMessage, '/clock', SENSOR)
        # Deep enough to notice every sender; the newest action still wins.
        self.create_subscription(ActionCommand, 'action', self._on_action, keep_several(COMMAND))
        self.create_service(Trigger, 'reset', self._on_reset)
        self.create_service(SetTask, 'set_task', self._on_set_task)
        self.create_service(SetBool, 'pause', self._on_pause)
        self.create_service(Trigger, 'step', self._on_step)
        self.add_post_set_parameters_callback(self._on_parameters_set)

        self._diagnostics = Diagnostics(
            self, self._examine, self._settings['diagnostics_period_s']
        )
        self._map.publish(occupancy_grid(self._simulator.maze, self._header()))
        self.get_logger().info(
            f'{spec.name}, {self._settings["stepping"]}: observations of {spec.obs_dim}, '
            f'actions of {spec.act_dim} values, {spec.num_tasks} tasks'
        )
        self._timer: Timer | None = None
        self._begin(self._simulator.reset_free(self._settings['seed']), self._settings['seed'])
        self._beats_per_step = 1
        self._pacer = Pacer(spec.control_period_s, time.monotonic())
        self._pace()

    def destroy_node(self) -> None:
        """Close the simulator, then destroy the node."""
        self._simulator.close()
        super().destroy_node()

    def _pace(self) -> None:
        """(Re)start the timer: of the steps and their count in realtime, else of the heartbeat."""
        if self._timer is not None:
            self.destroy_timer(self._timer)
        if self._lockstep:
            self._timer = self.create_timer(
                LOCKSTEP_HEARTBEAT_S, self._publish_state, clock=STEADY
            )
            return
        period_s = self._simulator.spec.control_period_s / self._settings['speed_factor']
        self._pacer = Pacer(period_s, time.monotonic())
        self._beats_per_step = math.ceil(period_s / HEARTBEAT_S)
        # Not the node's clock, which may be the simulated time published here.
        self._timer = self.create_timer(
            period_s / self._beats_per_step,
            self._on_tick,
            clock=STEADY,
        )

    def _on_parameters_set(self, parameters: list[Parameter]) -> None:
        if any(parameter.name == 'speed_factor' for parameter in parameters):
            self._pace()

    # --- stepping ----------------------------------------------------------------------------

    def _on_tick(self) -> None:
        if self._paused:
            self._publish_state()
            return
        lost = self._pacer.num_lost
        due = self._pacer.due(time.monotonic())
        for _ in range(due):
            self._advance_realtime()
        if not due and self._beats_per_step > 1:
            self._publish_state()
        if self._pacer.num_lost > lost:
            self.get_logger().warning(
                f'too slow for speed_factor {self._settings["speed_factor"]:g}: '
                f'{self._pacer.num_lost - lost} steps were dropped',
                throttle_duration_sec=5.0,
            )

    def _advance_realtime(self) -> None:
        age_s = (self._time_ns - self._action_time_ns) / 1e9
        fresh = age_s <= self._settings['action_timeout_s']
        self._advance(self._action if fresh else np.zeros_like(self._action))

    def _advance(self, action: NDArray[np.float64]) -> None:
        if self._monitor.num_senders() > 1:
            action = np.zeros_like(action)
        self._time_ns += self._period_ns
        if not (self._last.terminated or self._last.truncated):
            self._last = self._simulator.step(action)
            self._step += 1
        self._publish_state()

    def _on_action(self, message: ActionCommand) -> None:
        if message.world_id not in (0, self._world_id):
            return  # for another simulator, or the one before this
        if message.episode_id != self._episode_id:
            return  # for an episode that is over
        if self._lockstep and message.step != self._step:
            return
        if self._lockstep and (self._last.terminated or self._last.truncated):
            return
        values = to_array(message.values)
        fault = vector_fault('the action', values, self._simulator.spec.act_dim)
        self._monitor.saw_action(fault, message.instance)
        if fault:
            self.get_logger().warning(f'ignored: {fault}', throttle_duration_sec=5.0)
        elif self._lockstep and self._paused:
            self._awaiting = values
        elif self._lockstep:
            self._advance(values)
        else:
            self._action, self._action_time_ns = values, self._time_ns

    # --- pause -------------------------------------------------------------------------------

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        was, self._paused = self._paused, request.data
        if was and not self._paused:
            self._pace()
            self._advance_awaiting()
        response.success = True
        response.message = f'{"paused" if self._paused else "running"}, {self._where()}'
        return response

    def _on_step(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._paused:
            response.message = 'the simulation is running: pause it first'
        elif not self._lockstep:
            self._advance_realtime()
            response.success = True
        elif self._advance_awaiting():
            response.success = True
        else:
            response.message = f'no action was received for {self._where()}'
        response.message = response.message or self._where()
        return response

    def _advance_awaiting(self) -> bool:
        """Step with the lockstep action received while paused; false when there is none."""
        values, self._awaiting = self._awaiting, None
        if values is not None:
            self._advance(values)
        return values is not None

    def _where(self) -> str:
        return f'step {self._step} of episode {self._episode_id}'

    # --- episodes ----------------------------------------------------------------------------

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._begin(self._simulator.reset_free(), seed=0)
        response.success = True
        response.message = f'episode {self._episode_id} began, without a task'
        return response

    def _on_set_task(
        self, request: SetTask.Request, response: SetTask.Response
    ) -> SetTask.Response:
        try:
            observation, goal = self._simulator.reset(
                task_id=int(request.task_id), seed=int(request.seed)
            )
        except ValueError as error:
            response.message = str(error)
            return response
        self._begin(observation, int(request.seed), goal if request.send_goal else None)
        response.success = True
        response.message = f'episode {self._episode_id} began, task {request.task_id}'
        response.episode_id = self._episode_id
        response.world_id = self._world_id
        response.observation = to_floats(observation)
        response.goal = to_floats(goal)
        response.goal_position = to_point(goal[list(self._simulator.spec.position_dims)])
        return response

    def _begin(
        self,
        observation: NDArray[np.float64],
        seed: int,
        goal: NDArray[np.float64] | None = None,
    ) -> None:
        self._episode_id += 1
        self._step = 0
        self._last = StepResult(observation, False, False, False)
        self._action = np.zeros_like(self._action)
        self._awaiting = None
        self._events.publish(
            EpisodeEvent(
                header=self._header(),
                kind=EpisodeEvent.STARTED,
                episode_id=self._episode_id,
                position=to_point(self._simulator.position),
                goal=to_floats(() if goal is None else goal),
                seed=seed,
                world_id=self._world_id,
            )
        )
        self._publish_state()

    # --- output ------------------------------------------------------------------------------

    def _header(self) -> Header:
        return Header(stamp=to_time(self._time_ns), frame_id=self._settings['frame_id'])

    def _examine(self) -> Health:
        age_s = (self._time_ns - self._action_time_ns) / 1e9
        return self._monitor.examine(
            num_publishers=self.count_publishers('action'),
            action_is_old=not self._lockstep and age_s > self._settings['action_timeout_s'],
        )

    def _publish_state(self) -> None:
        self._monitor.states.add(time.monotonic())
        if self._lockstep and self._timer is not None:
            self._timer.reset()
        if self._clock_messages is not None:
            self._clock_messages.publish(ClockMessage(clock=to_time(self._time_ns)))
        self._states.publish(
            state_message(
                self._header(),
                episode_id=self._episode_id,
                step=self._step,
                observation=self._last.observation,
                position=self._simulator.position,
                terminated=self._last.terminated,
                truncated=self._last.truncated,
                success=self._last.success,
                world_id=self._world_id,
            )
        )
