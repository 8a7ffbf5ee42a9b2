"""Check a robot's contract, and whether a bag satisfies it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from metagcttt_core.config import Settings
from metagcttt_core.data import DatasetError
from metagcttt_core.robot import Contract, ContractError, load_contract
from metagcttt_core.robot.types import type_faults
from pydantic import Field
from tabulate import tabulate
import tyro

from metagcttt_tools.common.cli import fail, parse

_DESCRIPTION = """Check a robot's contract, and say what it reads and writes.

Example: metagcttt contract check config/robots/turtlebot3.yaml --bag drive.mcap
With a bag: whether its topics, fields, rates and stamps satisfy the contract. Ends with status 2
when they do not. config/robots/ has contracts to start from."""


class CheckSettings(Settings):
    """Settings of the program."""

    file: Annotated[Path, tyro.conf.Positional] = Field(
        Path('robot.yaml'), description='contract (YAML)'
    )
    bag: Path | None = Field(
        None, description='recording: a folder of ros2 bag, an .mcap or a .db3 file'
    )
    namespace: str = Field('', description='namespace of the robot in the bag')


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(CheckSettings, _DESCRIPTION, 'contract check', argv)
    from metagcttt_tools.robots.bag import Definitions, open_bag
    from metagcttt_tools.robots.episodes import read_episodes
    from metagcttt_tools.robots.report import bag_faults, describe_bag, message_faults

    try:
        contract = load_contract(settings.file)
        print(describe(contract))
        if settings.bag is None:
            faults = type_faults(contract, Definitions())
        else:
            with open_bag(settings.bag, contract, settings.namespace) as bag:
                faults = bag_faults(contract, bag)
                if not faults:
                    found = read_episodes(contract, bag.messages())
                    print(f'\n{describe_bag(found)}')
                    faults = message_faults(found)
    except ContractError as error:
        fail(*str(error).splitlines())
    except DatasetError as error:
        fail(str(error))
    if faults:
        fail(*faults)


def describe(contract: Contract) -> str:
    """What a contract reads and writes, as tables."""
    observed = [
        [column, topic.topic, value.field, f'{topic.stamp}, {topic.timeout_s:g} s']
        for topic in contract.observe
        for value in topic.values
        for column in value.columns
    ]
    commanded = [
        [topic.topic, f'{value.field}{f" of {joint}" if joint else ""}', *numbers]
        for topic in contract.act
        for value in topic.values
        for joint, *numbers in zip(
            value.joints or [''] * value.num_values,
            *value.limits,
            value.max_rates,
            value.reaches or [''] * value.num_values,
            strict=True,
        )
    ]
    return '\n'.join(
        [
            f'{contract.robot}: {contract.obs_dim} observed and {contract.act_dim} commanded '
            f'values at {contract.rate_hz:g} Hz',
            '',
            tabulate(observed, ['observed', 'topic', 'field', 'stamp, time-out']),
            '',
            tabulate(commanded, ['topic', 'commanded', 'low', 'high', 'per second', 'reach']),
            '',
            *(
                f'{topic.topic} without a command: '
                + ', '.join(f'{case} {what}' for case, what in topic.fallback)
                for topic in contract.act
            ),
        ]
    )
