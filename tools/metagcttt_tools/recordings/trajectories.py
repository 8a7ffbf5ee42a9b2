"""Trajectories from recordings of deployed robots, so that what they do becomes data."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.errors import DatasetError
import numpy as np

from metagcttt_tools.recordings.bags import read_bag
from metagcttt_tools.recordings.mcap import Recorded, RecordedMessages
from metagcttt_tools.recordings.robot import MISFITS, OTHER_STATE, Robot, usual_period_s

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


def read_recordings(
    paths: Sequence[Path], *, keep_idle: bool = False, refuse_gaps: bool = False
) -> tuple[TrajectoryDataset, RecordingSummary]:
    """Recordings as trajectories: state k with the action that led from it to state k + 1.

    That action is the newest one for state k that was published before state k + 1. Where there is
    none, or two states do not follow one another, the trajectory is cut: states are missing, a
    clock jumped, several robots publish on one topic, several policies send actions. In lockstep
    nothing is missing, so an episode is one trajectory, with the very observations and actions of
    the robot.

    Args:
        paths: Files or folders of recorder_node or `ros2 bag record`; the files of one split
            recording in order.
        keep_idle: Keep steps in which the robot had no goal.
        refuse_gaps: Fail where a trajectory would be cut, but for idle steps.

    Returns:
        The dataset, robots one after the other, and what was left out of it.

    Raises:
        DatasetError: If a file cannot be read, nothing usable is in the files, vectors differ in
            length, most of the messages do not belong together, or there is a gap and
            `refuse_gaps` is set.
    """
    if not paths:
        raise DatasetError('no recordings were given')
    contents = [read_bag(path, (STATE, ACTION)) for path in paths]
    by_robot = _by_robot(contents)
    dropped: Counter[str] = Counter()
    trajectories: list[tuple[np.ndarray, np.ndarray]] = []
    for name, messages in sorted(by_robot.items()):
        states = [m.recorded.message for m in messages if m.recorded.type_name == STATE]
        robot = Robot(name or '/', usual_period_s(states), keep_idle, refuse_gaps, dropped)
        trajectories += _trajectories(robot, messages)
    types = [placed.recorded.type_name for messages in by_robot.values() for placed in messages]
    num_kept = sum(len(observations) - 1 for observations, _ in trajectories)
    where = ', '.join(str(path) for path in paths)
    _refuse_mixtures(where, num_kept, types.count(ACTION), dropped)
    if not trajectories:
        topics = {name: kind for content in contents for name, kind in content.topics.items()}
        raise DatasetError(_nothing_found(where, topics, dropped))
    dataset = _join(trajectories)
    summary = RecordingSummary(
        states=types.count(STATE),
        actions=types.count(ACTION),
        transitions=dataset.num_transitions,
        trajectories=dataset.num_episodes,
        dropped=dict(dropped),
        unfinished=[p for p, c in zip(paths, contents, strict=True) if not c.complete],
    )
    return dataset, summary


class _Placed(NamedTuple):
    """A message with its recording, counted over the files, and its stretch in that."""

    recording: int
    stretch: int
    recorded: Recorded


def _by_robot(contents: Sequence[RecordedMessages]) -> dict[str, list[_Placed]]:
    """The messages by namespace; files that go on from the one before are one recording."""
    by_robot: dict[str, list[_Placed]] = defaultdict(list)
    recording = first_stretch = 0
    for index, content in enumerate(contents):
        if index and contents[index - 1].goes_on_in(content):
            first_stretch += contents[index - 1].num_stretches - 1
        else:
            recording, first_stretch = index, 0
        for recorded in content.messages:
            stretch = first_stretch + recorded.stretch
            by_robot[recorded.topic.rpartition('/')[0]].append(
                _Placed(recording, stretch, recorded)
            )
    return by_robot


def _trajectories(
    robot: Robot, messages: Sequence[_Placed]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The trajectories that a robot makes of its messages."""
    last = messages[0]
    for placed in messages:
        if placed.recording != last.recording:
            robot.finish()
        elif placed.stretch != last.stretch:
            robot.clock_jumped()
        last, recorded = placed, placed.recorded
        take = robot.take_state if recorded.type_name == STATE else robot.take_action
        take(recorded.message, recorded.published_ns)
    robot.finish()
    return robot.trajectories


def join_datasets(
    datasets: Iterable[TrajectoryDataset], *, contract: Mapping[str, Any] | None = None
) -> TrajectoryDataset:
    """All trajectories of several datasets, without their extras.

    Args:
        datasets: The datasets.
        contract: Identity of the contract that all of them satisfy, if any.

    Raises:
        DatasetError: If observations or actions differ in length.
    """
    datasets = list(datasets)
    return _join(
        [
            (dataset.states(slice(start, end + 1)), dataset.actions[start : end + 1])
            for dataset in datasets
            for start, end in zip(dataset.episode_starts, dataset.episode_ends, strict=True)
        ],
        contract,
    )


def _join(
    trajectories: list[tuple[np.ndarray, np.ndarray]], contract: Mapping[str, Any] | None = None
) -> TrajectoryDataset:
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
        contract=contract,
    )


def _refuse_mixtures(where: str, num_kept: int, num_actions: int, dropped: Counter[str]) -> None:
    """Refuse recordings whose messages mostly do not belong together."""
    misfits = {reason: dropped[reason] for reason in MISFITS if dropped[reason]}
    num_misfits = sum(misfits.values())
    if num_misfits > num_kept:
        reasons = ', '.join(f'{count} {reason}' for reason, count in misfits.items())
        raise DatasetError(
            f'{where}: {num_misfits} of {num_misfits + num_kept} steps do not follow from the '
            f'last ({reasons}): record one robot a topic, on one clock, and all of its messages'
        )
    if 2 * dropped[OTHER_STATE] > num_actions:
        raise DatasetError(
            f'{where}: {dropped[OTHER_STATE]} of {num_actions} actions are for another state than '
            'the last one before them: were states and actions published on different clocks?'
        )


def _nothing_found(where: str, topics: dict[str, str], dropped: Counter[str]) -> str:
    if STATE not in topics.values() or ACTION not in topics.values():
        listed = ', '.join(f'{topic} ({name})' for topic, name in topics.items()) or 'nothing'
        return f'{where}: needs topics of {STATE} and {ACTION}, got {listed}'
    left_out = ', '.join(f'{count} {reason}' for reason, count in dropped.items()) or 'nothing'
    return f'{where}: no step with an action; left out: {left_out}'
