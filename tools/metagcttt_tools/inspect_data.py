"""Say what is in a dataset, and draw where it has been."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import Settings
from metagcttt_core.data import DatasetError
from metagcttt_core.data.inspection import Column, inspect, Inspection
from metagcttt_core.robot import ContractError, load_contract
import numpy as np
from pydantic import Field
from tabulate import tabulate
import tyro

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.names import names_of

_DESCRIPTION = """Say what is in a dataset, and draw where it has been.

Example: metagcttt inspect data/robot.npz --contract config/robots/turtlebot3.yaml
Trajectories, ranges, outliers, columns that are frozen or twice there, steps that change nothing,
actions at their limits. Rates and gaps are in the recordings: metagcttt contract check --bag."""

_HEADERS = ['', 'lowest', '1 %', 'median', '99 %', 'highest', 'far out', 'unchanged']


class InspectSettings(Settings):
    """Settings of the program."""

    data: Annotated[Path, tyro.conf.Positional] = Field(
        Path('data/robot.npz'), description='dataset (npz or Minari)'
    )
    contract: Path | None = Field(
        None, description="the robot's contract (YAML), which names the columns"
    )
    coverage: tuple[int, int] = Field(
        (0, 1), description='observed values that are the axes of the picture'
    )
    out: Path = Field(Path('out/coverage.png'), description='picture of the coverage')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(InspectSettings, _DESCRIPTION, 'inspect', argv)
    from metagcttt_tools.common import plots

    try:
        dataset = TrajectoryDataset.load(settings.data)
        contract = load_contract(settings.contract) if settings.contract else None
        names = names_of(dataset, contract)
        found = inspect(dataset)
    except ContractError as error:
        fail(*str(error).splitlines())
    except DatasetError as error:
        fail(str(error))
    x, y = settings.coverage
    if not (0 <= x < dataset.obs_dim and 0 <= y < dataset.obs_dim):
        fail(f'coverage must be two of the observed values 0 to {dataset.obs_dim - 1}')
    print(dataset)
    print(describe(found, *names))
    places = dataset.observations[:, [x, y]]
    plots.save(plots.places_picture(places, names[0][x], names[0][y]), settings.out)
    print(f'coverage: {settings.out}')


def describe(found: Inspection, observed: Sequence[str], commanded: Sequence[str]) -> str:
    """What is in a dataset, as text."""
    shortest, middle, longest = np.percentile(found.lengths, (0, 50, 100))
    columns = list(
        zip((*observed, *commanded), (*found.observations, *found.actions), strict=True)
    )
    lines = [
        f'{len(found.lengths)} trajectories of {shortest:g} to {longest:g} transitions '
        f'(median {middle:g})',
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


def _row(name: str, column: Column) -> list[str | float | int]:
    return [name, *column.percentiles, column.outliers, f'{column.repeated:.0%}']
