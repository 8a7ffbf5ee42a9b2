"""Commands of a robot from actions of a policy, and actions from recorded commands."""

from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from metagcttt_core.robot.contract import Contract
from metagcttt_core.robot.errors import MessageError
from metagcttt_core.robot.numbers import read_numbers, write_numbers
from metagcttt_core.robot.topics import CommandTopic, measured_columns

_ROUNDING = 1e-6
"""Share of a range by which single-precision commands may exceed it."""


class Limits:
    """The map between actions, -1 to 1, and commands within the limits of one topic.

    Attributes:
        low: Lowest commands, shape (n,), in the units of the messages.
        high: Highest commands.
        max_rates: Fastest changes per second; infinite where there is no limit.
    """

    def __init__(self, contract: Contract, topic: CommandTopic) -> None:
        """Collect the limits of a topic's values.

        Args:
            contract: The contract, whose observations name the measured values.
            topic: Its topic.
        """
        limits = [value.limits for value in topic.values]
        self.low = np.concatenate([low for low, _ in limits])
        self.high = np.concatenate([high for _, high in limits])
        self.max_rates = np.concatenate([value.max_rates for value in topic.values])
        names = chain.from_iterable(
            measured_columns(value) or [''] * value.num_values for value in topic.values
        )
        self._sources = [(i, contract.columns.index(name)) for i, name in enumerate(names) if name]
        self._reaches = np.concatenate(
            [value.reaches or [np.nan] * value.num_values for value in topic.values]
        )
        self._relative = np.isfinite(self._reaches)

    def measured(self, observation: NDArray[np.floating]) -> NDArray[np.float64]:
        """What commands are measured against in observations (..., obs_dim); zeros for none."""
        found = np.zeros((*observation.shape[:-1], len(self.low)))
        for value, column in self._sources:
            found[..., value] = observation[..., column]
        return found

    def to_command(
        self, action: ArrayLike, observation: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """The command (..., n) for an action; one beyond -1 to 1 is commanded as its bound.

        Args:
            action: (..., n), the part of the topic.
            observation: (..., obs_dim), what the action answers.
        """
        low, high = self._range(observation)
        share = (np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0) + 1.0) / 2.0
        return np.clip(low + share * (high - low), self.low, self.high)

    def check(self, command: NDArray[np.float64]) -> None:
        """Refuse a command (n,) outside the limits by more than rounding.

        Raises:
            MessageError: If it is.
        """
        slack = _ROUNDING * (self.high - self.low)
        if ((command < self.low - slack) | (command > self.high + slack)).any():
            raise MessageError(
                f'commands {command.tolist()}, outside the limits {self.low.tolist()} to '
                f'{self.high.tolist()}'
            )

    def to_action(
        self, command: ArrayLike, observation: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """The action that a command (n,) stands for, the inverse of `to_command`.

        Args:
            command: In the units of the messages.
            observation: (obs_dim,), what it answers.

        Raises:
            MessageError: If the command is outside the limits, or further from the measured
                values than their reach, by more than rounding.
        """
        given = np.asarray(command, dtype=np.float64)
        self.check(given)
        low, high = self._range(observation)
        action = 2.0 * (given - low) / (high - low) - 1.0
        if (self._relative & (np.abs(action) > 1.0 + 2.0 * _ROUNDING)).any():
            raise MessageError(
                f'commands {given.tolist()}, further than {self._reaches.tolist()} from the '
                f'measured {self.measured(observation).tolist()}: widen reach in the contract'
            )
        return np.clip(action, -1.0, 1.0)

    def _range(
        self, observation: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The commands, each (..., n), that the actions -1 and 1 stand for."""
        measured = self.measured(observation)
        return (
            np.where(self._relative, measured - self._reaches, self.low),
            np.where(self._relative, measured + self._reaches, self.high),
        )

    def approach(
        self, target: NDArray[np.float64], last: NDArray[np.float64], seconds: float
    ) -> NDArray[np.float64]:
        """The command nearest to `target` that is in reach of the last one within `seconds`."""
        reach = np.full_like(self.max_rates, np.inf)
        np.multiply(self.max_rates, seconds, out=reach, where=np.isfinite(self.max_rates))
        return np.clip(target, last - reach, last + reach)


class Commander:
    """Commands for one topic, each within the limits and in reach of the one before.

    A command older than the topic's time-out is no longer measured against: the next one starts
    from the measured values, or from zero where the contract names none.
    """

    def __init__(self, contract: Contract, topic: CommandTopic) -> None:
        """Start without a command.

        Args:
            contract: The contract, whose observations name the measured values.
            topic: The topic to command.
        """
        self._topic = topic
        self._period_s = 1.0 / contract.rate_hz
        self._limits = Limits(contract, topic)
        self._last: NDArray[np.float64] | None = None
        self._last_ns = 0

    def command(
        self, action: ArrayLike, observation: NDArray[np.float64], now_ns: int
    ) -> NDArray[np.float64]:
        """The command for an action at `now_ns`, nanoseconds of a monotonic clock."""
        seconds = (now_ns - self._last_ns) / 1e9
        if self._last is None or seconds > self._topic.timeout_s:
            start = self._limits.measured(observation)
            last, seconds = np.clip(start, self._limits.low, self._limits.high), self._period_s
        else:
            last = self._last
        wanted = self._limits.to_command(action, observation)
        return self._sent(self._limits.approach(wanted, last, seconds), now_ns)

    def fall_back(self, reaction: str, now_ns: int) -> NDArray[np.float64] | None:
        """The command instead of the policy's; none where nothing is to be sent.

        Zeros are sent at once unless the contract limits the changes of stops too.
        """
        if reaction == 'nothing' or (reaction == 'hold' and self._last is None):
            return None
        if reaction == 'hold':
            assert self._last is not None
            return self._sent(self._last, now_ns)
        zeros = np.zeros_like(self._limits.low)
        if self._topic.stops_within_rates and self._last is not None:
            zeros = self._limits.approach(zeros, self._last, (now_ns - self._last_ns) / 1e9)
        return self._sent(zeros, now_ns)

    def _sent(self, command: NDArray[np.float64], now_ns: int) -> NDArray[np.float64]:
        self._last, self._last_ns = command, now_ns
        return command


def split_action(contract: Contract, action: NDArray[np.floating]) -> list[NDArray[np.floating]]:
    """The parts (..., n) of actions (..., act_dim), one for each command topic."""
    sizes = [sum(value.num_values for value in topic.values) for topic in contract.act]
    return np.split(action, np.cumsum(sizes)[:-1], axis=-1)


def write_command(topic: CommandTopic, message: Any, command: NDArray[np.float64]) -> None:
    """Put a command into the fields of a message."""
    start = 0
    for value in topic.values:
        write_numbers(value, message, command[start : start + value.num_values])
        start += value.num_values


def read_command(topic: CommandTopic, message: Any) -> NDArray[np.float64]:
    """The command that a recorded message holds.

    Raises:
        MessageError: If a field, a joint or a number is missing, or a number is not finite.
    """
    return np.concatenate([read_numbers(value, message) for value in topic.values])
