"""Trajectories from recordings of deployed robots, so that what they do becomes data."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.errors import DatasetError
import numpy as np

from metagcttt_tools.recordings.mcap import read_messages, Recorded

STATE = 'metagcttt_interfaces/msg/MazeState'
ACTION = 'metagcttt_interfaces/msg/ActionCommand'


@dataclass(frozen=True)
class RecordingSummary:
    """Counts of kept and dropped messages.

    Attributes:
        states: Recorded states.
        actions: Recorded actions.
        transitions: Transitions of the dataset.
        trajectories: Trajectories of the dataset.
        dropped: How often something was left out, by reason.
        unfinished: Files whose recorder did not end properly; their last second may be missing.
    """

    states: int
    actions: int
    transitions: int
    trajectories: int
    dropped: dict[str, int]
    unfinished: list[Path]


@dataclass
class _Robot:
    """Turns one robot's messages, in the order of publication, into trajectories."""

    name: str
    keep_idle: bool
    refuse_gaps: bool
    dropped: Counter[str]
    trajectories: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    _state: Any = None
    _action: Any = None
    _rows: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def take_action(self, message: Any) -> None:
        """Remember the newest action for the current state; the simulator does the same."""
        state = self._state
        if state is None or (message.episode_id, message.step) != (state.episode_id, state.step):
            self.dropped['actions for another state than the last one'] += 1
        elif not np.isfinite(message.values).all():
            self.dropped['actions that are not finite'] += 1
        else:
            self._action = message

    def take_state(self, message: Any) -> None:
        """Add the transition to this state, or say why there is none."""
        last = self._state
        if not np.isfinite(message.observation).all():
            self.dropped['states that are not finite'] += 1
            return
        if last is not None:
            if (message.episode_id, message.step) == (last.episode_id, last.step) and (
                list(message.observation) == list(last.observation)
            ):
                self.dropped['repeated states'] += 1
                return
            reason = self._break(last, message)
            if reason:
                self._cut(reason)
            elif (message.episode_id, message.step) == (last.episode_id, last.step + 1):
                self._rows.append((np.array(last.observation), np.array(self._action.values)))
            else:
                self.finish()  # a new episode
        self._state, self._action = message, None

    def finish(self) -> None:
        """Close the trajectory under way with its last state, which has no action."""
        if self._rows:
            observations = [observation for observation, _ in self._rows]
            actions = [action for _, action in self._rows]
            observations.append(np.array(self._state.observation))
            actions.append(np.zeros_like(actions[0]))
            self.trajectories.append((self._stack(observations), self._stack(actions)))
        self._rows = []

    def _break(self, last: Any, state: Any) -> str:
        """The reason why two states of an episode form no transition; empty if they do."""
        if state.episode_id != last.episode_id:
            return ''
        if state.step <= last.step:
            return 'steps back in time'
        if state.step != last.step + 1:
            return 'gaps between states'
        if self._action is None:
            return 'states without an action'
        if not self.keep_idle and not self._action.query_id:
            return 'idle steps'
        return ''

    def _cut(self, reason: str) -> None:
        if self.refuse_gaps and reason != 'idle steps':
            raise DatasetError(
                f'{self.name}: {reason} after step {self._state.step} of episode '
                f'{self._state.episode_id}'
            )
        self.dropped[reason] += 1
        self.finish()

    def _stack(self, rows: list[np.ndarray]) -> np.ndarray:
        sizes = sorted({len(row) for row in rows})
        if len(sizes) > 1:
            raise DatasetError(
                f'{self.name}: vectors of {sizes[0]} and {sizes[1]} values in episode '
                f'{self._state.episode_id}; they must be equally long'
            )
        return np.stack(rows)


def read_recordings(
    paths: Sequence[Path], *, keep_idle: bool = False, refuse_gaps: bool = False
) -> tuple[TrajectoryDataset, RecordingSummary]:
    """Recordings as trajectories: state k with the action that led from it to state k + 1.

    That action is the newest one for state k that was published before state k + 1. Where there is
    none, or states are missing, the trajectory is cut. In lockstep nothing is missing, so an
    episode is one trajectory, with the very observations and actions of the robot.

    Args:
        paths: Files of recorder_node or `ros2 bag record`; those of one split recording in order.
        keep_idle: Keep steps in which the robot had no goal.
        refuse_gaps: Fail where a trajectory would be cut, but for idle steps.

    Returns:
        The dataset, robots one after the other, and what was left out of it.

    Raises:
        DatasetError: If a file cannot be read, nothing usable is in the files, vectors differ in
            length, or there is a gap and `refuse_gaps` is set.
    """
    if not paths:
        raise DatasetError('no recordings were given')
    by_robot: dict[str, list[Recorded]] = defaultdict(list)
    topics: dict[str, str] = {}
    unfinished = []
    for path in paths:
        content = read_messages(path, (STATE, ACTION))
        topics |= content.topics
        if not content.complete:
            unfinished.append(path)
        for recorded in content.messages:
            by_robot[recorded.topic.rpartition('/')[0]].append(recorded)
    dropped: Counter[str] = Counter()
    trajectories: list[tuple[np.ndarray, np.ndarray]] = []
    for name, messages in sorted(by_robot.items()):
        robot = _Robot(name or '/', keep_idle, refuse_gaps, dropped)
        for recorded in messages:
            if recorded.type_name == STATE:
                robot.take_state(recorded.message)
            else:
                robot.take_action(recorded.message)
        robot.finish()
        trajectories += robot.trajectories
    if not trajectories:
        raise DatasetError(_nothing_found(paths, topics, dropped))
    dataset = _join(trajectories)
    types = [recorded.type_name for messages in by_robot.values() for recorded in messages]
    summary = RecordingSummary(
        states=types.count(STATE),
        actions=types.count(ACTION),
        transitions=dataset.num_transitions,
        trajectories=dataset.num_episodes,
        dropped=dict(dropped),
        unfinished=unfinished,
    )
    return dataset, summary


def join_datasets(datasets: Iterable[TrajectoryDataset]) -> TrajectoryDataset:
    """All trajectories of several datasets, without their extras.

    Raises:
        DatasetError: If observations or actions differ in length.
    """
    datasets = list(datasets)
    return _join(
        [
            (dataset.observations[start : end + 1], dataset.actions[start : end + 1])
            for dataset in datasets
            for start, end in zip(dataset.episode_starts, dataset.episode_ends, strict=True)
        ]
    )


def _join(trajectories: list[tuple[np.ndarray, np.ndarray]]) -> TrajectoryDataset:
    sizes = sorted({(o.shape[1], a.shape[1]) for o, a in trajectories})
    if len(sizes) > 1:
        raise DatasetError(
            'trajectories of different robots: (observation, action) of '
            + ' and of '.join(f'{size} values' for size in sizes)
        )
    terminals = [np.arange(len(o)) == len(o) - 1 for o, _ in trajectories]
    return TrajectoryDataset.from_arrays(
        np.concatenate([o for o, _ in trajectories]),
        np.concatenate([a for _, a in trajectories]),
        np.concatenate(terminals),
    )


def _nothing_found(paths: Sequence[Path], topics: dict[str, str], dropped: Counter[str]) -> str:
    where = ', '.join(str(path) for path in paths)
    if STATE not in topics.values() or ACTION not in topics.values():
        listed = ', '.join(f'{topic} ({name})' for topic, name in topics.items()) or 'nothing'
        return f'{where}: needs topics of {STATE} and {ACTION}, got {listed}'
    left_out = ', '.join(f'{count} {reason}' for reason, count in dropped.items()) or 'nothing'
    return f'{where}: no step with an action; left out: {left_out}'
