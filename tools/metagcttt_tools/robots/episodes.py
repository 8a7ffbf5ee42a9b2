"""Trajectories from recorded messages of a robot, by its contract."""

from bisect import bisect_right
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

from metagcttt_core.data import DatasetError, TrajectoryDataset
from metagcttt_core.robot import Contract, MessageError, Observer
from metagcttt_core.robot.commands import Limits, read_command
from metagcttt_core.robot.topics import CommandTopic
import numpy as np

from metagcttt_tools.robots.bag import Recorded


@dataclass
class TopicCount:
    """What became of the messages of a topic.

    Attributes:
        received: Their number.
        refused: How many did not satisfy the contract.
        reason: Why the first one of those did not.
        first_ns: Reception of the first message.
        last_ns: Reception of the last one.
    """

    received: int = 0
    refused: int = 0
    reason: str = ''
    first_ns: int = 0
    last_ns: int = 0

    @property
    def rate_hz(self) -> float:
        """Mean rate of the messages; 0 when there are less than two."""
        seconds = (self.last_ns - self.first_ns) / 1e9
        return (self.received - 1) / seconds if seconds > 0 else 0.0

    def add(self, received_ns: int, refusal: str) -> None:
        """Count a message."""
        self.first_ns = self.first_ns if self.received else received_ns
        self.last_ns = received_ns
        self.received += 1
        self.refused += bool(refusal)
        self.reason = self.reason or refusal


@dataclass
class Episodes:
    """What a recording holds by the contract.

    Attributes:
        counts: By topic of the contract.
        ticks: Control periods of the recording.
        observed: Those with an observation.
        late: How often there was none, by the topic that was late.
        trajectories: Observations (T + 1, obs_dim) and actions (T + 1, act_dim), both float64.
    """

    counts: dict[str, TopicCount]
    ticks: int = 0
    observed: int = 0
    late: dict[str, int] = field(default_factory=dict)
    trajectories: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def dataset(self, longest: int | None = None) -> TrajectoryDataset:
        """All trajectories.

        Args:
            longest: Most transitions of a trajectory; longer ones are cut into several, of which
                one begins in the row where the one before ends, so that no transition is lost.

        Raises:
            DatasetError: If there is none.
        """
        if not self.trajectories:
            raise DatasetError('no control period has both an observation and a command')
        pieces = [
            (observations[start : start + step + 1], actions[start : start + step + 1])
            for observations, actions in self.trajectories
            for step in [longest or len(actions) - 1]
            for start in range(0, len(actions) - 1, step)
        ]
        return TrajectoryDataset.from_arrays(
            np.concatenate([observations for observations, _ in pieces]),
            np.concatenate([actions for _, actions in pieces]),
            np.concatenate([np.arange(len(o)) == len(o) - 1 for o, _ in pieces]),
        )


@dataclass(frozen=True)
class _Row:
    tick: int
    segment: int
    time_ns: int
    observation: np.ndarray


class _Commands:
    """The recorded commands of one topic, which become actions where they answer something."""

    def __init__(self, contract: Contract, topic: CommandTopic) -> None:
        self._topic = topic
        self._limits = Limits(contract, topic)
        self._timeout_ns = round(topic.timeout_s * 1e9)
        self._times_ns: list[int] = []
        self._commands: list[np.ndarray | None] = []

    def add(self, message: Any, time_ns: int) -> str:
        """Take in a message; returns why it is refused, or nothing.

        Raises:
            DatasetError: If it commands something outside the limits.
        """
        command, refusal = None, ''
        try:
            command = read_command(self._topic, message)
        except MessageError as error:
            refusal = f'{self._topic.topic}: {error}'
        self._times_ns.append(time_ns)
        self._commands.append(command)
        if command is not None:
            with self._naming(len(self._commands)):
                self._limits.check(command)
        return refusal

    def action(self, row: _Row, stop_ns: int) -> np.ndarray | None:
        """That of the first command from a row to `stop_ns`, or of the one in force before it.

        Raises:
            DatasetError: If the command is out of reach of what the row observes.
        """
        number = bisect_right(self._times_ns, row.time_ns)
        if number == len(self._times_ns) or self._times_ns[number] > stop_ns:
            number -= 1
            if number < 0 or row.time_ns - self._times_ns[number] > self._timeout_ns:
                return None
        command = self._commands[number]
        if command is None:
            return None
        with self._naming(number + 1):
            return self._limits.to_action(command, row.observation)

    @contextmanager
    def _naming(self, number: int) -> Iterator[None]:
        try:
            yield
        except MessageError as error:
            raise DatasetError(f'{self._topic.topic}, message {number}: {error}') from error


def read_episodes(contract: Contract, messages: Iterable[Recorded]) -> Episodes:
    """The trajectories that a robot drove, one row a control period.

    A policy that is deployed answers an observation within the period; so the action of a row is
    the first command after it. A trajectory ends where an observation is late or there is no
    command.

    Args:
        contract: The contract.
        messages: In the order of reception.

    Raises:
        DatasetError: If a command is outside the limits of the contract, or out of reach.
    """
    commands = {topic.topic: _Commands(contract, topic) for topic in contract.act}
    topics = [topic.topic for topic in contract.topics]
    found = Episodes({topic: TopicCount() for topic in topics})
    observer = Observer(contract)
    rows: list[_Row] = []
    tick_ns, received_ns = None, 0

    for topic, message, received_ns in messages:
        tick_ns = received_ns if tick_ns is None else tick_ns
        while tick_ns < received_ns:
            _sample(observer, tick_ns, found, rows)
            tick_ns += contract.period_ns
        taken = (
            commands[topic].add(message, received_ns)
            if topic in commands
            else observer.take(topic, message, received_ns)
        )
        found.counts[topic].add(received_ns, taken)
    if tick_ns == received_ns:
        _sample(observer, tick_ns, found, rows)
    found.trajectories = _trajectories(contract, rows, list(commands.values()))
    return found


def _sample(observer: Observer, tick_ns: int, found: Episodes, rows: list[_Row]) -> None:
    observation = observer.sample(tick_ns)
    if observation is None:
        topic = observer.late.partition(':')[0]
        found.late[topic] = found.late.get(topic, 0) + 1
    else:
        found.observed += 1
        rows.append(_Row(found.ticks, observer.segment, tick_ns, observation))
    found.ticks += 1


def _trajectories(
    contract: Contract, rows: list[_Row], commands: list[_Commands]
) -> list[tuple[np.ndarray, np.ndarray]]:
    trajectories: list[tuple[np.ndarray, np.ndarray]] = []
    for _, segment in groupby(rows, key=lambda row: row.segment):
        observations: list[np.ndarray] = []
        actions: list[np.ndarray] = []
        for row in segment:
            end_ns = row.time_ns + contract.period_ns
            parts = [each.action(row, end_ns) for each in commands]
            observations.append(row.observation)
            complete = [part for part in parts if part is not None]
            if len(complete) == len(parts):
                actions.append(np.concatenate(complete))
                continue
            _close(contract, observations, actions, trajectories)
            observations, actions = [], []
        _close(contract, observations, actions[: max(len(observations) - 1, 0)], trajectories)
    return trajectories


def _close(
    contract: Contract,
    observations: list[np.ndarray],
    actions: list[np.ndarray],
    trajectories: list[tuple[np.ndarray, np.ndarray]],
) -> None:
    """Add a trajectory, whose last row has no action, unless it has no transition."""
    if actions:
        still = np.zeros(contract.act_dim)
        trajectories.append((np.stack(observations), np.stack([*actions, still])))
