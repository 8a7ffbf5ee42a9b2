"""Trajectories from recorded messages of a robot, by its contract."""

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import groupby

from metagcttt_core.data import DatasetError, TrajectoryDataset
from metagcttt_core.robot import Contract, MessageError, Observer
from metagcttt_core.robot.commands import Limits, read_command
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
    """The recorded commands of one topic as actions."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_ns = round(timeout_s * 1e9)
        self._times_ns: list[int] = []
        self._actions: list[np.ndarray | None] = []

    def add(self, time_ns: int, action: np.ndarray | None) -> None:
        self._times_ns.append(time_ns)
        self._actions.append(action)

    def between(self, start_ns: int, stop_ns: int) -> np.ndarray | None:
        """The first command of a control period, else the one still in force at its start."""
        index = bisect_right(self._times_ns, start_ns)
        if index < len(self._times_ns) and self._times_ns[index] <= stop_ns:
            return self._actions[index]
        if index and start_ns - self._times_ns[index - 1] <= self._timeout_ns:
            return self._actions[index - 1]
        return None


def read_episodes(contract: Contract, messages: Iterable[Recorded]) -> Episodes:
    """The trajectories that a robot drove, one row a control period.

    A policy that is deployed answers an observation within the period; so the action of a row is
    the first command after it. A trajectory ends where an observation is late or there is no
    command.

    Args:
        contract: The contract.
        messages: In the order of reception.

    Raises:
        DatasetError: If a command is outside the limits of the contract.
    """
    acted = {topic.topic: topic for topic in contract.act}
    limits = {topic.topic: Limits(topic) for topic in contract.act}
    commands = {topic.topic: _Commands(topic.timeout_s) for topic in contract.act}
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
        if topic not in acted:
            found.counts[topic].add(received_ns, observer.take(topic, message, received_ns))
            continue
        try:
            command, refusal = read_command(acted[topic], message), ''
        except MessageError as error:
            commands[topic].add(received_ns, None)
            refusal = f'{topic}: {error}'
        else:
            try:
                commands[topic].add(received_ns, limits[topic].to_action(command))
            except MessageError as error:
                message_number = found.counts[topic].received + 1
                raise DatasetError(f'{topic}, message {message_number}: {error}') from error
        found.counts[topic].add(received_ns, refusal)
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
            parts = [each.between(row.time_ns, end_ns) for each in commands]
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
