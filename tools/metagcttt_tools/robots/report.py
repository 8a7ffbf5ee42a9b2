"""What a bag holds by a contract, and what of the contract it does not satisfy."""

from metagcttt_core.robot import Contract
from metagcttt_core.robot.types import type_faults
from tabulate import tabulate

from metagcttt_tools.robots.bag import Bag
from metagcttt_tools.robots.episodes import Episodes


def bag_faults(contract: Contract, bag: Bag) -> list[str]:
    """Topics that a bag lacks or has with other types, and fields that its types lack."""
    faults = []
    for topic in contract.topics:
        found = bag.types.get(topic.topic)
        if found is None:
            listed = ', '.join(f'{name} ({kind})' for name, kind in bag.all_topics.items())
            faults.append(f'{topic.topic}: not in the bag (there are: {listed or "no topics"})')
        elif found != topic.type:
            faults.append(f'{topic.topic}: of type {found} in the bag, not {topic.type}')
    return faults or type_faults(contract, bag.definitions)


def describe_bag(found: Episodes) -> str:
    """What a bag holds by a contract, as text."""
    rows = [
        [topic, count.received, f'{count.rate_hz:.1f}', count.refused]
        for topic, count in found.counts.items()
    ]
    transitions = sum(len(actions) - 1 for _, actions in found.trajectories)
    return '\n'.join(
        [
            tabulate(rows, ['topic', 'messages', 'Hz', 'refused'], disable_numparse=True),
            '',
            f'{found.observed} of {found.ticks} periods have an observation; '
            f'{transitions} transitions in {len(found.trajectories)} trajectories',
            *(f'  {count} periods without {topic}' for topic, count in found.late.items()),
        ]
    )


def message_faults(found: Episodes) -> list[str]:
    """Messages that a contract refuses, by topic, and topics without any."""
    faults = []
    for topic, count in found.counts.items():
        if not count.received:
            faults.append(f'{topic}: no messages')
        elif count.refused:
            faults.append(f'{count.refused} of {count.received} refused, first: {count.reason}')
    if not found.trajectories:
        faults.append('no control period has both an observation and a command')
    return faults
