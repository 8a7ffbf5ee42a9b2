"""Turn a LeRobotDataset v3 into a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from metagcttt_core.config import Settings
from metagcttt_core.config.yaml_file import SettingsFileError
from metagcttt_core.data import DatasetError
from metagcttt_core.robot import ContractError, load_contract
from pydantic import Field
import tyro

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.session import writes_dataset
from metagcttt_tools.common.sources import made_by

_DESCRIPTION = """Turn a LeRobotDataset v3 (parquet files) into a dataset (.npz).

Example: metagcttt import-lerobot ~/lerobot/pusht --limits-from-data --out data/pusht.npz
Takes observation.state and action, or what a contract or a column map names; trajectories are cut
where episode_index changes. Pictures are left out. No package of LeRobot's is needed."""


class LeRobotSettings(Settings):
    """Settings of the program."""

    folder: Annotated[Path, tyro.conf.Positional] = Field(
        Path('data/lerobot'), description='the folder that holds meta and data'
    )
    columns: Path | None = Field(
        None, description='column map (YAML): which features are observed and commanded'
    )
    contract: Path | None = Field(
        None,
        description="the robot's contract (YAML): picks values of observation.state and action "
        'by their names, and gives the limits',
    )
    limits_from_data: bool = Field(
        False, description='where no limits are given, take the extremes of the data'
    )
    trust_rows: bool = Field(
        False, description='go by the rows where the metadata say otherwise, which is refused'
    )
    out: Path = Field(Path('data/lerobot.npz'), description='dataset to write')
    overwrite: bool = Field(False, description='replace an existing dataset')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(LeRobotSettings, _DESCRIPTION, 'import-lerobot', argv)
    with writes_dataset(settings.out, settings.overwrite):
        _run(settings)


def _run(settings: LeRobotSettings) -> None:
    from metagcttt_tools.tables.columns import load_columns, map_of_contract
    from metagcttt_tools.tables.lerobot import ACTION, DEFAULT_MAP, READ, read_lerobot, STATE

    if settings.columns and settings.contract:
        fail('give columns or contract, not both')
    try:
        columns, identity = DEFAULT_MAP, None
        if settings.columns:
            columns = load_columns(settings.columns)
        if settings.contract:
            contract = load_contract(settings.contract)
            identity = contract.identity
            columns = map_of_contract(contract, observed_in=STATE, commanded_in=ACTION)
        found = read_lerobot(
            settings.folder,
            columns,
            trust_rows=settings.trust_rows,
            limits_from_data=settings.limits_from_data,
        )
    except (ContractError, SettingsFileError) as error:
        fail(*str(error).splitlines())
    except DatasetError as error:
        fail(str(error))
    found.dataset.contract = identity
    described_by = [path for path in (settings.columns, settings.contract) if path]
    found.dataset.made_from = made_by(
        'import-lerobot', [*described_by, settings.folder], within=READ
    )
    found.dataset.save(settings.out)
    print(f'{found.dataset}: {settings.out}')
    print('  cut where episode_index changes', *found.in_words(), sep='\n')
