"""Write a dataset as a LeRobotDataset v3."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import tempfile
from typing import Annotated

from metagcttt_core import TrajectoryDataset
from metagcttt_core.config import Settings
from metagcttt_core.data import DatasetError
from metagcttt_core.robot import Contract, ContractError, load_contract
from metagcttt_core.robot.commands import Limits, split_action
import numpy as np
from pydantic import Field
import tyro

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.session import sole_writer

_DESCRIPTION = """Write a dataset as a LeRobotDataset v3 (parquet files).

Example: metagcttt export-lerobot data/robot.npz --contract config/robots/turtlebot3.yaml
With the robot's contract, values have its names and actions are commands in its units. The last
row of a trajectory, whose action was never taken, has next.done."""


class ExportSettings(Settings):
    """Settings of the program."""

    data: Annotated[Path, tyro.conf.Positional] = Field(
        Path('data/robot.npz'), description='dataset (npz or Minari)'
    )
    contract: Path | None = Field(None, description="the robot's contract (YAML)")
    fps: int | None = Field(
        None, ge=1, description='rows a second; by default the rate of the contract'
    )
    task: str = Field('reach the goal', description='what the robot does, in words')
    rows_per_file: int = Field(
        200_000, ge=1, description='rows from which the next trajectory goes into a new file'
    )
    out: Path = Field(Path('data/lerobot'), description='folder to write')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(ExportSettings, _DESCRIPTION, 'export-lerobot', argv)
    from metagcttt_tools.common.names import names_of

    if os.path.lexists(settings.out):
        fail(f'{settings.out} exists: give another --out')
    try:
        dataset = TrajectoryDataset.load(settings.data)
        contract = load_contract(settings.contract) if settings.contract else None
        observed, commanded = names_of(dataset, contract)
    except ContractError as error:
        fail(*str(error).splitlines())
    except DatasetError as error:
        fail(str(error))
    fps = settings.fps or _rate(contract)
    with sole_writer(settings.out):
        _write(settings, dataset, contract, fps, observed, commanded)
    print(f'{dataset}: {settings.out}')
    print(f'  {fps} frames a second; actions {"in units of the robot" if contract else "-1 to 1"}')


def _write(
    settings: ExportSettings,
    dataset: TrajectoryDataset,
    contract: Contract | None,
    fps: int,
    observed: list[str],
    commanded: list[str],
) -> None:
    from metagcttt_tools.tables.lerobot_writer import write_lerobot

    # Whole or not at all: the folder gets its name when all is in it.
    part = Path(tempfile.mkdtemp(dir=settings.out.parent, prefix=f'.{settings.out.name}.'))
    try:
        write_lerobot(
            part,
            dataset,
            fps=fps,
            task=settings.task,
            robot=contract.robot if contract else 'unknown',
            observed=observed,
            commanded=commanded,
            actions=_commands(contract, dataset),
            rows_a_file=settings.rows_per_file,
        )
        part.chmod(0o755)
        part.rename(settings.out)
    except BaseException:
        shutil.rmtree(part)
        raise


def _rate(contract: Contract | None) -> int:
    if contract is None:
        fail('how many rows a second? Give --fps, or --contract')
    if contract.rate_hz != round(contract.rate_hz):
        fail(f'LeRobot counts whole frames a second, {contract.rate_hz:g} are not: give --fps')
    return round(contract.rate_hz)


def _commands(contract: Contract | None, dataset: TrajectoryDataset) -> np.ndarray:
    """Actions in units of the robot, where it is known."""
    if contract is None:
        return np.asarray(dataset.actions)
    parts = [
        Limits(contract, topic).to_command(part, dataset.states(slice(None)))
        for topic, part in zip(contract.act, split_action(contract, dataset.actions), strict=True)
    ]
    return np.hstack(parts)
