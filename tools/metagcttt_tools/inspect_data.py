"""Say what is in a dataset, and draw where it has been."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import Settings
from metagcttt_core.config.yaml_file import SettingsFileError
from metagcttt_core.data import DatasetError
from metagcttt_core.data.inspection import Column, inspect, Inspection, Pace
from metagcttt_core.files import refuse_foreign
from metagcttt_core.robot import Contract, ContractError, load_contract
import numpy as np
from pydantic import Field
from tabulate import tabulate
import tyro

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.names import names_of
from metagcttt_tools.common.sources import in_words

_DESCRIPTION = """Say what is in data, and draw where it has been.

Example: metagcttt inspect data/robot.npz --contract config/robots/turtlebot3.yaml
Trajectories, rates, gaps, ranges, outliers, columns that are frozen or twice there, steps that
change nothing, actions at their limits. Takes datasets (npz, Minari), folders of LeRobot, CSV and
parquet files with --columns, and bags with --contract. What is no dataset yet is not written."""

_HEADERS = ['', 'lowest', '1 %', 'median', '99 %', 'highest', 'far out', 'unchanged']
_TABLES = ('.csv', '.parquet')
_BAGS = ('.mcap', '.db3')


class InspectSettings(Settings):
    """Settings of the program."""

    data: Annotated[Path, tyro.conf.Positional] = Field(
        Path('data/robot.npz'), description='dataset, table, LeRobot folder or bag'
    )
    contract: Path | None = Field(
        None, description="the robot's contract (YAML): names the columns, and reads bags"
    )
    columns: Path | None = Field(
        None, description='column map (YAML) of a table or a LeRobot folder'
    )
    coverage: tuple[int, int] = Field(
        (0, 1), description='observed values that are the axes of the picture'
    )
    out: Path = Field(Path('out/coverage.png'), description='picture of the coverage')


class Opened(NamedTuple):
    """Data of whatever form, names of their values, remarks on the form, and a contract's rate."""

    dataset: TrajectoryDataset
    observed: Sequence[str]
    commanded: Sequence[str]
    remarks: list[str]
    rate_hz: float | None = None


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(InspectSettings, _DESCRIPTION, 'inspect', argv)
    from metagcttt_tools.common import plots

    try:
        refuse_foreign(settings.out)
        opened = open_data(settings)
        found = inspect(opened.dataset)
    except (ContractError, SettingsFileError) as error:
        fail(*str(error).splitlines())
    except (DatasetError, FileExistsError) as error:
        fail(str(error))
    x, y = settings.coverage
    width = opened.dataset.obs_dim
    if not (0 <= x < width and 0 <= y < width):
        fail(f'coverage must be two of the observed values 0 to {width - 1}')
    print(*opened.remarks, opened.dataset, sep='\n')
    print(describe(found, opened.observed, opened.commanded, opened.rate_hz))
    places = opened.dataset.states(slice(None))[:, [x, y]]
    plots.save(plots.places_picture(places, opened.observed[x], opened.observed[y]), settings.out)
    print(f'coverage: {settings.out}')


def open_data(settings: InspectSettings) -> Opened:
    """The data, by their form.

    Raises:
        ContractError, SettingsFileError: For a wrong contract or column map.
        DatasetError: If the data cannot be read, or their form takes what was not given.
    """
    path = settings.data
    contract = load_contract(settings.contract) if settings.contract else None
    if path.suffix in _BAGS or (path / 'metadata.yaml').is_file():
        return _open_bag(path, contract)
    if path.suffix in _TABLES or (path / 'meta' / 'info.json').is_file():
        return _open_table(path, contract, settings.columns)
    dataset = TrajectoryDataset.load(path)
    rate_hz = contract.rate_hz if contract else (dataset.contract or {}).get('rate_hz')
    remarks = [in_words(dataset.made_from)] if dataset.made_from else []
    return Opened(dataset, *names_of(dataset, contract), remarks, rate_hz)


def _open_bag(path: Path, contract: Contract | None) -> Opened:
    from metagcttt_tools.robots.bag import open_bag
    from metagcttt_tools.robots.episodes import read_episodes
    from metagcttt_tools.robots.report import bag_faults, describe_bag

    if contract is None:
        raise DatasetError(f'{path}: a bag takes a contract: give --contract')
    with open_bag(path, contract) as bag:
        if faults := bag_faults(contract, bag):
            raise DatasetError('\n'.join(faults))
        episodes = read_episodes(contract, bag.messages())
        dataset = episodes.dataset()
    return Opened(
        dataset, *names_of(dataset, contract), [describe_bag(episodes), ''], contract.rate_hz
    )


def _open_table(path: Path, contract: Contract | None, columns: Path | None) -> Opened:
    from metagcttt_tools.tables.columns import load_columns, map_of_contract
    from metagcttt_tools.tables.lerobot import ACTION, DEFAULT_MAP, read_lerobot, STATE
    from metagcttt_tools.tables.rows import read_tables

    if path.suffix in _TABLES:
        if columns is None:
            raise DatasetError(f'{path}: a table takes a column map: give --columns')
        found = read_tables([path], load_columns(columns), limits_from_data=True)
    else:
        chosen = DEFAULT_MAP
        if columns:
            chosen = load_columns(columns)
        elif contract:
            chosen = map_of_contract(contract, observed_in=STATE, commanded_in=ACTION)
        found = read_lerobot(path, chosen, limits_from_data=True)
    return Opened(found.dataset, found.observed, found.commanded, found.in_words())


def describe(
    found: Inspection,
    observed: Sequence[str],
    commanded: Sequence[str],
    rate_hz: float | None = None,
) -> str:
    """What is in a dataset, as text; `rate_hz` is that of its contract."""
    shortest, middle, longest = np.percentile(found.lengths, (0, 50, 100))
    columns = list(
        zip((*observed, *commanded), (*found.observations, *found.actions), strict=True)
    )
    lines = [
        f'{len(found.lengths)} trajectories of {shortest:g} to {longest:g} transitions '
        f'(median {middle:g})',
        _pace_in_words(found.pace, rate_hz),
        '',
        tabulate([_row(name, column) for name, column in columns], _HEADERS, floatfmt='.4g'),
        '',
    ]
    if found.repeated_rows:
        lines.append(f'{found.repeated_rows} transitions leave the observation as it is')
    lines += [f'{name} never changes' for name, column in columns if column.is_frozen]
    for names, group in ((observed, found.observations), (commanded, found.actions)):
        lines += [
            f'{name} has the values of {names[column.same_as]}'
            for name, column in zip(names, group, strict=True)
            if column.same_as is not None
        ]
    lines += [
        f'{name} is at a limit in {column.at_limit:.0%} of the transitions'
        for name, column in zip(commanded, found.actions, strict=True)
        if column.at_limit
    ]
    return '\n'.join(lines)


def _pace_in_words(pace: Pace | None, rate_hz: float | None) -> str:
    if pace is None and rate_hz is not None:
        return f'{rate_hz:g} Hz by the contract; a gap ends a trajectory'
    if pace is None:
        return 'rates and gaps are not known: there are no times in the data'
    low, _, high = pace.steps_s
    text = f'{pace.rate_hz:.4g} Hz; 98 % of the steps take {low:.4g} to {high:.4g} s'
    if not pace.gaps:
        return f'{text}; no gaps'
    return (
        f'{text}; {pace.gaps} gaps, the longest of {pace.longest_s:.4g} s after row '
        f'{pace.longest_row}'
    )


def _row(name: str, column: Column) -> list[str | float | int]:
    return [name, *column.percentiles, column.outliers, f'{column.repeated:.0%}']
