"""Commands of a robot from actions of a policy, and actions from recorded commands."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from metagcttt_core.robot.contract import CommandTopic, Contract, measured_columns
from metagcttt_core.robot.errors import MessageError
from metagcttt_core.robot.numbers import read_numbers, write_numbers

_ROUNDING = 1e-6
"""Share of a range by which single-precision commands may exceed it."""


class Limits:
    """The map between actions, -1 to 1, and commands within the limits of one topic.

    Attributes:
        low: Lowest commands, shape (n,), in the units of the messages.
        high: Highest commands.
        max_rates: Fastest changes per second; infinite where there is no limit.
    """

    def __init__(self, topic: CommandTopic) -> None:
        """Collect the limits of a topic's values."""
        limits = [value.limits for value in topic.values]
        self.low = np.concatenate([low for low, _ in limits])
        self.high = np.concatenate([high for _, high in limits])
        self.max_rates = np.concatenate([value.max_rates for value in topic.values])

    def to_command(self, action: ArrayLike) -> NDArray[np.float64]:
        """The command for an action; one beyond -1 to 1 is commanded as its bound."""
        share = (np.asarray(action, dtype=np.float64) + 1.0) / 2.0
        return np.clip(self.low + share * (self.high - self.low), self.low, self.high)

    def to_action(self, command: ArrayLike) -> NDArray[np.float64]:
        """The action that a command stands for, the inverse of `to_command`.

        Raises:
            MessageError: If the command is outside the limits by more than rounding.
        """
        given = np.asarray(command, dtype=np.float64)
        slack = _ROUNDING * (self.high - self.low)
        if ((given < self.low - slack) | (given > self.high + slack)).any():
            raise MessageError(
                f'commands {given.tolist()}, outside the limits {self.low.tolist()} to '
                f'{self.high.tolist()}'
            )
        return np.clip(2.0 * (given - self.low) / (self.high - self.low) - 1.0, -1.0, 1.0)

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
        self._limits = Limits(topic)
        self._measured = [
            [contract.columns.index(name) for name in measured_columns(value)]
            for value in topic.values
        ]
        self._last: NDArray[np.float64] | None = None
        self._last_ns = 0

    def command(
        self, action: ArrayLike, observation: NDArray[np.float64], now_ns: int
    ) -> NDArray[np.float64]:
        """The command for an action at `now_ns`, nanoseconds of a monotonic clock."""
        seconds = (now_ns - self._last_ns) / 1e9
        if self._last is None or seconds > self._topic.timeout_s:
            last, seconds = self._start(observation), self._period_s
        else:
            last = self._last
        return self._sent(
            self._limits.approach(self._limits.to_command(action), last, seconds), now_ns
        )

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

    def _start(self, observation: NDArray[np.float64]) -> NDArray[np.float64]:
        parts = [
            observation[columns] if columns else np.zeros(value.num_values)
            for value, columns in zip(self._topic.values, self._measured, strict=True)
        ]
        return np.clip(np.concatenate(parts), self._limits.low, self._limits.high)

    def _sent(self, command: NDArray[np.float64], now_ns: int) -> NDArray[np.float64]:
        self._last, self._last_ns = command, now_ns
        return command


def split_action(contract: Contract, action: NDArray[np.floating]) -> list[NDArray[np.floating]]:
    """The parts of an action, one for each command topic."""
    sizes = [sum(value.num_values for value in topic.values) for topic in contract.act]
    return np.split(action, np.cumsum(sizes)[:-1])


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
