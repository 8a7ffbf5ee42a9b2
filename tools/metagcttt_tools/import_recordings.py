"""Turn recordings of deployed robots into a dataset, so that deployments grow the data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import Settings
from metagcttt_core.data import DatasetError
from pydantic import Field

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.session import writes_dataset
from metagcttt_tools.common.sources import made_by

if TYPE_CHECKING:
    from metagcttt_tools.recordings.trajectories import RecordingSummary

_DESCRIPTION = """Turn recordings of recorder_node or `ros2 bag record` into a dataset (.npz).

Example: metagcttt import-recordings --recordings run.mcap --out data/run.npz
State k goes with the action that led to state k + 1; where one of them is missing, the trajectory
is cut. What was left out is printed."""


class RecordingSettings(Settings):
    """Settings of the program."""

    recordings: tuple[Path, ...] = Field(
        (), description='.mcap or .db3 files, or bag folders; files of a split one in order'
    )
    out: Path = Field(Path('data/recorded.npz'), description='dataset to write')
    extend: Path | None = Field(
        None, description='dataset whose trajectories are put before the recorded ones'
    )
    keep_idle: bool = Field(False, description='keep steps in which the robot had no goal')
    refuse_gaps: bool = Field(False, description='fail where a trajectory would be cut')
    overwrite: bool = Field(False, description='replace an existing dataset')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(RecordingSettings, _DESCRIPTION, 'import-recordings', argv)
    with writes_dataset(settings.out, settings.overwrite):
        _run(settings)


def _run(settings: RecordingSettings) -> None:
    from metagcttt_tools.recordings.trajectories import join_datasets, read_recordings

    try:
        dataset, summary = read_recordings(
            settings.recordings, keep_idle=settings.keep_idle, refuse_gaps=settings.refuse_gaps
        )
        extended = [settings.extend] if settings.extend is not None else []
        if extended:
            dataset = join_datasets([*map(TrajectoryDataset.load, extended), dataset])
        dataset.made_from = made_by('import-recordings', [*extended, *settings.recordings])
    except DatasetError as error:
        fail(str(error))
    dataset.save(settings.out)
    print(describe(summary))
    print(f'{dataset}: {settings.out}')


def describe(summary: RecordingSummary) -> str:
    """A summary of what was kept and what was dropped, as text."""
    lines = [
        f'{summary.states} states and {summary.actions} actions became {summary.transitions} '
        f'transitions in {summary.trajectories} trajectories'
    ]
    lines += [f'  left out: {count} {reason}' for reason, count in summary.dropped.items()]
    lines += [f'  without its end: {path}' for path in summary.unfinished]
    return '\n'.join(lines)
