"""The node between a policy and a robot that speaks standard messages."""

from functools import partial
from pathlib import Path
import secrets
import time
from typing import Any

from metagcttt_core.robot import ContractError, load_contract, Observer
from metagcttt_core.robot.commands import write_command
from metagcttt_core.robot.types import has_header, type_faults
from metagcttt_interfaces.msg import ActionCommand, MazeState
import numpy as np
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool

from metagcttt.clocks import JumpFreeClock
from metagcttt.conventions import ConventionalNode
from metagcttt.converters import state_message, to_array
from metagcttt.diagnostics import Diagnostics
from metagcttt.health import Faults, Health, Level, Rate
from metagcttt.input_checks import Senders
from metagcttt.parameter_set import ParameterSet
from metagcttt.parameters import ROBOT_BRIDGE_NODE
from metagcttt.qos import COMMAND, keep_several, state_offer
from metagcttt.robot.messages import definitions, message_class, profile
from metagcttt.robot.pilot import Pilot, Situation

WARNING_PERIOD_S = 5.0
RESTART = Duration(seconds=-1)
EPISODE = 1
LEVELS = {'fault': Level.ERROR, 'stop': Level.WARN, 'silent': Level.WARN}


class RobotBridgeNode(ConventionalNode):
    """Publishes a robot's state at the rate of its contract, and the policy's actions as commands.

    A robot is never reset, so there is one episode. Observations go by the node's clock, with
    which the contract's `stamp: header` compares the robot's, and on simulated time so do rates of
    commands; deadlines of commands go by a steady one, as simulated time may stand still. Where
    simulated time goes back, the simulation was started again: that is another world, in which no
    goal is in force.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Load the contract and connect to its topics.

        Args:
            kwargs: For `rclpy.node.Node`.

        Raises:
            ContractError: If the contract is wrong or its message types do not have its fields.
        """
        super().__init__('robot_bridge_node', **kwargs)
        self._settings = ParameterSet(self, ROBOT_BRIDGE_NODE, is_configured=lambda: True)
        self._contract = load_contract(Path(self._settings['contract']).expanduser())
        if faults := type_faults(self._contract, definitions):
            raise ContractError('\n'.join(faults))
        self._fingerprint = self._contract.identity['fingerprint']
        self._observer = Observer(self._contract)
        self._pilot = Pilot(self._contract)
        self._robot_clock = JumpFreeClock(self)
        self._begin_world()
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=RESTART),
            post_callback=self._on_time_back,
        )
        self._policies = Senders()
        self._faults = Faults()
        self._rate = Rate()
        self._step = 0
        self._ended = False

        self._states = self.create_publisher(MazeState, 'state', state_offer('realtime'))
        self._stamped = [has_header(topic.type, definitions) for topic in self._contract.act]
        self._commands = [
            self.create_publisher(message_class(topic.type), topic.topic, profile(topic.qos))
            for topic in self._contract.act
        ]
        for topic in self._contract.observe:
            self.create_subscription(
                message_class(topic.type),
                topic.topic,
                partial(self._on_message, topic.topic),
                profile(topic.qos),
            )
        self.create_subscription(ActionCommand, 'action', self._on_action, keep_several(COMMAND))
        self.create_subscription(Bool, 'stop', self._on_stop, keep_several(COMMAND))
        self.create_service(SetBool, 'set_stop', self._on_set_stop)
        period_s = 1.0 / self._contract.rate_hz
        self.create_timer(period_s, self._on_tick)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(period_s, self._on_watchdog, clock=steady)
        self._diagnostics = Diagnostics(
            self, self._examine, self._settings['diagnostics_period_s']
        )
        self.get_logger().info(
            f'{self._contract.robot}: observations of {self._contract.obs_dim} and actions of '
            f'{self._contract.act_dim} values at {self._contract.rate_hz:g} Hz'
        )

    def destroy_node(self) -> None:
        """Stop following the clock, then destroy the node."""
        self._jumps.unregister()
        self._robot_clock.close()
        super().destroy_node()

    def end_service(self) -> None:
        """Send the last commands; nothing is sent after them."""
        self._ended = True
        for number, command in self._pilot.farewell(self._robot_ns()):
            self._send(number, command)

    def _begin_world(self) -> None:
        """Draw the identity of a world in which nothing was observed yet."""
        self._world_id = secrets.randbits(64) or 1  # 0 stands for none
        self._observer.begin_again()
        self._pilot.forget()

    def _on_time_back(self, jump: TimeJump) -> None:
        """Begin another world: the simulation of the robot was started again."""
        self._begin_world()
        seconds = -jump.delta.nanoseconds / 1e9
        self.get_logger().warning(
            f'the clock went back by {seconds:.1f} s: another world begins, and no goal is in it'
        )

    # --- input -------------------------------------------------------------------------------

    def _on_message(self, topic: str, message: Any) -> None:
        refusal = self._observer.take(topic, message, self._now_ns())
        if refusal:
            self._note('refused_messages', refusal)

    def _on_action(self, message: ActionCommand) -> None:
        self._policies.saw(message.instance, time.monotonic())
        if message.world_id not in (0, self._world_id):
            self._note('refused_actions', 'the action is for another world')
            return
        if message.episode_id != EPISODE:
            self._note('refused_actions', f'the action is for episode {message.episode_id}')
            return
        refusal = self._pilot.take_action(
            message.step, message.query_id, to_array(message.values), withheld=message.withheld
        )
        if refusal:
            self._note('refused_actions', refusal)
        else:
            self._act(due=self._pilot.repeats)

    def _on_stop(self, message: Bool) -> None:
        if message.data:
            self._stop('stopped by the topic stop')

    def _on_set_stop(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        if request.data:
            self._stop('stopped by the service set_stop')
        else:
            self._pilot.stopped = ''
        response.success = True
        response.message = self._pilot.stopped or 'not stopped'
        return response

    def _stop(self, reason: str) -> None:
        self._pilot.stopped = reason
        self._act(due=False)

    def _note(self, kind: str, reason: str) -> None:
        self._faults.note(kind, reason, time.monotonic())
        self.get_logger().warning(reason, throttle_duration_sec=WARNING_PERIOD_S)

    # --- behaviour ---------------------------------------------------------------------------

    def _on_tick(self) -> None:
        """Publish the state, unless a topic is late."""
        observation = self._observer.sample(self._now_ns())
        if observation is None:
            self._act(due=False)  # a fallback does not wait
            return
        self._step += 1
        self._pilot.saw_observation(self._step, observation, time.monotonic_ns())
        self._rate.add(time.monotonic())
        x, y = self._position(observation)
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._contract.frame_id)
        self._states.publish(
            state_message(
                header,
                episode_id=EPISODE,
                world_id=self._world_id,
                step=self._step,
                observation=observation,
                position=(x, y),
                terminated=False,
                truncated=False,
                success=False,
                contract=self._fingerprint,
            )
        )

    def _on_watchdog(self) -> None:
        self._act(due=True)

    def _act(self, *, due: bool) -> None:
        if self._ended:
            return
        self._pilot.fault = self._observer.late or self._rivals()
        for number, command in self._pilot.commands(
            time.monotonic_ns(), due=due, robot_ns=self._robot_ns()
        ):
            self._send(number, command)

    def _robot_ns(self) -> int:
        """The time by which the robot moves; never goes back."""
        if self.get_parameter('use_sim_time').value:
            return round(self._robot_clock.now_s() * 1e9)
        return time.monotonic_ns()

    def _rivals(self) -> str:
        """Who else commands the robot; empty when nobody does."""
        if self._policies.count(time.monotonic()) > 1:
            return 'several policies act in this graph'
        for publisher in self._commands:
            if self.count_publishers(publisher.topic_name) > 1:
                return f'others publish on {publisher.topic_name}'
        return ''

    def _strangers(self) -> str:
        """Who publishes what is observed as another type, which never arrives; or empty."""
        for topic in self._contract.observe:
            name = self.resolve_topic_name(topic.topic)
            types = {each.topic_type for each in self.get_publishers_info_by_topic(name)}
            if types and topic.type not in types:
                return (
                    f'{topic.topic} is published as {", ".join(sorted(types))}, not {topic.type}'
                )
        return ''

    def _send(self, number: int, command: NDArray[np.float64]) -> None:
        topic = self._contract.act[number]
        message = message_class(topic.type)()
        if self._stamped[number]:
            message.header.stamp = self.get_clock().now().to_msg()
            message.header.frame_id = topic.frame_id
        write_command(topic, message, command)
        self._commands[number].publish(message)

    def _position(self, observation: NDArray[np.float64]) -> tuple[float, float]:
        if self._contract.position is None:
            return 0.0, 0.0
        x, y = (self._contract.columns.index(name) for name in self._contract.position)
        return float(observation[x]), float(observation[y])

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _examine(self) -> Health:
        now_ns = time.monotonic_ns()
        found = [(t.topic, self._pilot.situation(t, now_ns)) for t in self._contract.act]
        worst = max((s for _, s in found), key=lambda s: LEVELS.get(s.case, Level.OK))
        strangers = self._strangers() if self._observer.late else ''
        recent = self._faults.recent(now_ns / 1e9)
        level = LEVELS.get(worst.case, Level.WARN if recent else Level.OK)
        return Health(
            level,
            strangers or worst.reason or recent or 'the policy commands',
            {
                'state_rate_hz': f'{self._rate.per_second(now_ns / 1e9):.1f}',
                **{topic: _in_words(situation) for topic, situation in found},
                **{kind: str(count) for kind, count in self._faults.counts.items()},
            },
        )


def _in_words(situation: Situation) -> str:
    return f'{situation.case}: {situation.reason}' if situation.case else 'the policy commands'
