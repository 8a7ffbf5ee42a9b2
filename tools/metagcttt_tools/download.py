"""Download OGBench's published datasets of its mazes."""

from http.client import HTTPException
from pathlib import Path

from metagcttt_core import DatasetError, TrajectoryDataset
from metagcttt_core.config import Settings
from pydantic import Field
from sim_bridge import describe_environment, SimulatorSpec
import tyro

from metagcttt_tools.common.cli import fail, parse

_DESCRIPTION = """Download OGBench's published datasets of its mazes.

Example: metagcttt download antmaze-medium-navigate-v0
Fetches NAME.npz and NAME-val.npz through the ogbench package, showing progress, and checks them.
Files that are there already are only checked; they can also be copied there by hand."""


class DownloadSettings(Settings):
    """Settings of the program."""

    names: tyro.conf.Positional[tuple[str, ...]] = Field(
        ('antmaze-medium-navigate-v0',),
        min_length=1,
        description='datasets, as OGBench names them',
    )
    folder: Path = Field(Path('data'), description='where the files go')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(DownloadSettings, _DESCRIPTION, 'download', argv)
    try:
        specs = [describe_environment(name).spec for name in settings.names]
        for name, spec in zip(settings.names, specs, strict=True):
            download(name, settings.folder)
            for path in files_of(name, settings.folder):
                print(f'{path}: {check(path, spec)}')
    except ValueError as error:
        fail(str(error))
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def files_of(name: str, folder: Path) -> tuple[Path, Path]:
    """Training and validation file of a dataset."""
    return folder / f'{name}.npz', folder / f'{name}-val.npz'


def download(name: str, folder: Path) -> None:
    """Fetch the files of a dataset that are not there.

    Raises:
        DatasetError: If they cannot be fetched; says what to do.
    """
    import ogbench

    missing = [path for path in files_of(name, folder) if not path.exists()]
    if not missing:
        return
    try:
        ogbench.download_datasets([name], str(folder))
    except (OSError, HTTPException) as error:  # URLError, a broken connection, a full disk
        raise DatasetError(
            f'{name}: cannot be downloaded ({error}); without a network, copy '
            f'{" and ".join(str(path) for path in missing)} from a machine that has one, '
            'or make the data with metagcttt generate'
        ) from error


def check(path: Path, spec: SimulatorSpec) -> TrajectoryDataset:
    """Read a dataset and see that it is of the robot.

    Raises:
        DatasetError: If it is incomplete or of another robot; says what to do.
    """
    try:
        dataset = TrajectoryDataset.load(path)
    except DatasetError as error:
        raise DatasetError(f'{error}; remove the file and download it again') from error
    found = dataset.obs_dim, dataset.act_dim
    if found != (spec.obs_dim, spec.act_dim):
        raise DatasetError(
            f'{path}: has {found[0]} observation and {found[1]} action dimensions, '
            f'{spec.name} has {spec.obs_dim} and {spec.act_dim}'
        )
    return dataset
