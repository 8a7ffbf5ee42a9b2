"""Turn bags of a robot into a dataset, by its contract."""

from __future__ import annotations

from pathlib import Path

from metagcttt_core.config import Settings
from metagcttt_core.data import DatasetError
from metagcttt_core.robot import ContractError, load_contract
from pydantic import Field

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.session import writes_dataset
from metagcttt_tools.common.sources import made_by

_DESCRIPTION = """Turn bags of a robot into a dataset (.npz), by its contract.

Example: metagcttt import-bags --contract config/robots/turtlebot3.yaml --bags drive.mcap
A row a control period; the action is the first command after the observation. Where one of them
is missing, the trajectory is cut, and after --longest-s where that is given: goals of a row are
later ones of its trajectory, and the filter takes one stretch of each. What was left out is
printed."""


class BagSettings(Settings):
    """Settings of the program."""

    contract: Path = Field(Path('robot.yaml'), description="the robot's contract (YAML)")
    bags: tuple[Path, ...] = Field(
        (), description='recordings: folders of ros2 bag, .mcap or .db3 files'
    )
    namespace: str = Field('', description='namespace of the robot in the bags')
    longest_s: float | None = Field(
        None, gt=0, description='cut longer trajectories into several of so many seconds'
    )
    out: Path = Field(Path('data/robot.npz'), description='dataset to write')
    overwrite: bool = Field(False, description='replace an existing dataset')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(BagSettings, _DESCRIPTION, 'import-bags', argv)
    with writes_dataset(settings.out, settings.overwrite):
        _run(settings)


def _run(settings: BagSettings) -> None:
    from metagcttt_tools.recordings.trajectories import join_datasets
    from metagcttt_tools.robots.bag import open_bag
    from metagcttt_tools.robots.episodes import read_episodes
    from metagcttt_tools.robots.report import bag_faults, describe_bag

    if not settings.bags:
        fail('no bags were given: --bags FILE...')
    datasets = []
    try:
        contract = load_contract(settings.contract)
        longest = None
        if settings.longest_s is not None:
            longest = max(1, round(settings.longest_s * contract.rate_hz))
        for path in settings.bags:
            with open_bag(path, contract, settings.namespace) as bag:
                if faults := bag_faults(contract, bag):
                    fail(*(f'{path}: {fault}' for fault in faults))
                found = read_episodes(contract, bag.messages())
                datasets.append(found.dataset(longest))
            print(f'{path}\n{describe_bag(found)}')
            for count in found.counts.values():
                if count.refused:
                    print(f'  left out: {count.refused} messages, first: {count.reason}')
    except ContractError as error:
        fail(*str(error).splitlines())
    except DatasetError as error:
        fail(str(error))
    dataset = join_datasets(datasets, contract=contract.identity)
    dataset.made_from = made_by('import-bags', [settings.contract, *settings.bags])
    dataset.save(settings.out)
    print(f'{dataset}: {settings.out}')
