"""Decisions about a robot's commands: the policy's action, or what the contract falls back on."""

from dataclasses import dataclass

from metagcttt_core.robot import Contract
from metagcttt_core.robot.commands import Commander, split_action
from metagcttt_core.robot.topics import CommandTopic
import numpy as np
from numpy.typing import NDArray

from metagcttt.input_checks import vector_fault

REMEMBERED_STEPS = 1000


@dataclass(frozen=True)
class _Action:
    values: NDArray[np.float64]
    withheld: bool
    query_id: int
    observed_ns: int
    observation: NDArray[np.float64]


@dataclass(frozen=True)
class Situation:
    """Why a topic does not get the policy's command.

    Attributes:
        case: A case of the contract's `fallback`; empty when the policy commands.
        reason: The same in words.
    """

    case: str = ''
    reason: str = ''


class Pilot:
    """Turns actions into commands that are within limits, in reach and never too old.

    All times are nanoseconds of one monotonic clock, but for those of the robot's own clock, by
    which commands are in reach of one another: simulated time may be faster or stand still.

    Attributes:
        stopped: Why the robot is stopped, until it is cleared; empty when it is not.
        fault: Why there must be no command now, such as a late topic; set by the owner.
        repeats: Whether the newest action only repeats the answer to the same observation.
    """

    def __init__(self, contract: Contract) -> None:
        """Start without an action."""
        self._contract = contract
        self._commanders = [Commander(contract, topic) for topic in contract.act]
        self._sent_ns = [-contract.period_ns] * len(contract.act)
        self._steps: dict[int, tuple[int, NDArray[np.float64]]] = {}
        self._action: _Action | None = None
        self.stopped = ''
        self.fault = ''
        self.repeats = False

    def saw_observation(self, step: int, observation: NDArray[np.float64], now_ns: int) -> None:
        """Remember when an observation was made, which limits the age of its action."""
        self._steps[step] = (now_ns, observation)
        self._steps.pop(step - REMEMBERED_STEPS, None)

    def take_action(
        self, step: int, query_id: int, values: NDArray[np.float64], *, withheld: bool = False
    ) -> str:
        """Take in the action for the observation of `step`; returns why it is refused, or ''.

        Args:
            step: The step that it answers.
            query_id: The goal that it serves; 0 for none.
            values: The action; zeros are an action like any other.
            withheld: The policy says that it does not act, whatever the values are.
        """
        if fault := vector_fault('the action', values, self._contract.act_dim):
            return fault
        if step not in self._steps:
            return f'the action answers step {step}, which was not observed lately'
        observed_ns, observation = self._steps[step]
        if self._action is not None and observed_ns < self._action.observed_ns:
            return f'the action for step {step} came after that for a newer one'
        last = self._action
        self._action = _Action(values, withheld, query_id, observed_ns, observation)
        self.repeats = last is not None and (
            (last.observed_ns, last.query_id, last.withheld) == (observed_ns, query_id, withheld)
        )
        return ''

    def forget(self) -> None:
        """Forget observations and actions, which are of another world now."""
        self._steps.clear()
        self._action = None

    def situation(self, topic: CommandTopic, now_ns: int) -> Situation:
        """The reason to fall back, or none."""
        action = self._action
        if self.stopped:
            return Situation('stop', self.stopped)
        if self.fault:
            return Situation('fault', self.fault)
        if action is None:
            return Situation('silent', 'no action yet')
        age_s = (now_ns - action.observed_ns) / 1e9
        if age_s > topic.timeout_s:
            return Situation('silent', f'the newest action is for {age_s:.2f} s ago')
        if not action.query_id:
            return Situation('no_goal', 'no goal')
        if action.withheld:
            return Situation('silent', 'the policy keeps the robot still')
        return Situation()

    def commands(
        self, now_ns: int, *, due: bool, robot_ns: int | None = None
    ) -> list[tuple[int, NDArray[np.float64]]]:
        """The commands to send now, each with the number of its topic in the contract.

        Args:
            now_ns: The time.
            robot_ns: The time of the robot, if it has another clock.
            due: Only those that are due, because the last one is a period old: the next action is
                under way, and a repetition before it would be taken for its answer.
        """
        found = []
        robot_ns = now_ns if robot_ns is None else robot_ns
        for number, (topic, commander) in enumerate(
            zip(self._contract.act, self._commanders, strict=True)
        ):
            if due and now_ns - self._sent_ns[number] < self._contract.period_ns:
                continue
            case = self.situation(topic, now_ns).case
            if case:
                command = commander.fall_back(getattr(topic.fallback, case), robot_ns)
            else:
                assert self._action is not None
                part = split_action(self._contract, self._action.values)[number]
                command = commander.command(part, self._action.observation, robot_ns)
            if command is not None:
                self._sent_ns[number] = now_ns
                found.append((number, command))
        return found

    def farewell(self, robot_ns: int) -> list[tuple[int, NDArray[np.float64]]]:
        """The last commands, as the contract says for the end of the bridge."""
        last = [
            commander.fall_back(topic.fallback.shutdown, robot_ns)
            for topic, commander in zip(self._contract.act, self._commanders, strict=True)
        ]
        return [(number, command) for number, command in enumerate(last) if command is not None]
