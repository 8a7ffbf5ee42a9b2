"""Turn CSV or parquet files into a dataset, by a column map."""

from __future__ import annotations

from pathlib import Path

from metagcttt_core.config import Settings
from metagcttt_core.config.yaml_file import SettingsFileError
from metagcttt_core.data import DatasetError
from pydantic import Field

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.session import writes_dataset
from metagcttt_tools.common.sources import made_by

_DESCRIPTION = """Turn CSV or parquet files into a dataset (.npz), by a column map (YAML).

Example: metagcttt import-table --columns columns.yaml --tables drive.csv --out data/drive.npz
The map names the observed and the commanded columns and says where trajectories are cut:
  observations: [x, y, heading]
  actions: [{column: v, low: -0.3, high: 0.3}, {column: w, low: -1.5, high: 1.5}]
  position: [x, y]
  time: t
  cut: {episode: run}"""


class TableSettings(Settings):
    """Settings of the program."""

    tables: tuple[Path, ...] = Field((), description='files: .csv or .parquet')
    columns: Path = Field(Path('columns.yaml'), description='the column map (YAML)')
    limits_from_data: bool = Field(
        False, description='where the map gives none, take the extremes of the data as limits'
    )
    out: Path = Field(Path('data/table.npz'), description='dataset to write')
    overwrite: bool = Field(False, description='replace an existing dataset')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(TableSettings, _DESCRIPTION, 'import-table', argv)
    with writes_dataset(settings.out, settings.overwrite):
        _run(settings)


def _run(settings: TableSettings) -> None:
    from metagcttt_tools.tables.columns import load_columns
    from metagcttt_tools.tables.rows import read_tables

    if not settings.tables:
        fail('no tables were given: --tables FILE...')
    try:
        columns = load_columns(settings.columns)
        found = read_tables(settings.tables, columns, limits_from_data=settings.limits_from_data)
    except SettingsFileError as error:
        fail(*str(error).splitlines())
    except DatasetError as error:
        fail(str(error))
    found.dataset.made_from = made_by('import-table', [settings.columns, *settings.tables])
    found.dataset.save(settings.out)
    assert columns.cut is not None
    print(f'{found.dataset}: {settings.out}')
    print(f'  cut where {columns.cut.in_words()}', *found.in_words(), sep='\n')
