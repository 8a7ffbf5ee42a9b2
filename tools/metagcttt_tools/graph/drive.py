"""The graph of a robot and one policy after another as processes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
from functools import partial
import os
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

from domain_coordinator import domain_id
from metagcttt.commander import NoAnswerError
import rclpy
from tqdm import tqdm

from metagcttt_tools.graph.client import GoalOutcome, MazeClient
from metagcttt_tools.graph.process import NodeProcess

Parameters = Mapping[str, bool | int | float | str]
Drive = Callable[[MazeClient], GoalOutcome]
ArmT = TypeVar('ArmT')
OutcomeT = TypeVar('OutcomeT')

START_TIMEOUT_S = 120.0
_LOCKSTEP = {'stepping': 'lockstep'}


class Executable(NamedTuple):
    """What to start: an executable of a ROS package, with parameters."""

    name: str
    parameters: Parameters
    package: str = 'metagcttt'


class Client(Protocol):
    """A program's view of a robot."""

    def wait_until_ready(self, timeout_s: float) -> None:
        """Wait until the nodes hear each other and this program."""

    def destroy_node(self) -> None:
        """Leave the graph."""


ClientT = TypeVar('ClientT', bound=Client)


def drive_arms(
    arms: Mapping[ArmT, Parameters],
    drives: Sequence[Drive],
    *,
    logs: Path,
    simulator: Parameters | None = None,
    goal_node: Parameters | None = None,
) -> dict[ArmT, list[GoalOutcome]]:
    """Outcome of every drive in a maze by arm, from three processes in lockstep.

    Args:
        arms: Parameters of policy_node by arm.
        drives: What to do with each arm.
        logs: Folder for what the nodes print.
        simulator: Parameters of sim_bridge_node.
        goal_node: Parameters of goal_node.

    Raises:
        NodeFailedError: If a node ends; with its log.
        NoAnswerError: If a node does not answer in time; with all logs.
    """
    return drive_policies(
        [
            Executable('sim_bridge_node', {**_LOCKSTEP, **(simulator or {})}),
            Executable('goal_node', {**_LOCKSTEP, **(goal_node or {})}),
        ],
        {arm: {'adaptation': 'hold', **_LOCKSTEP, **given} for arm, given in arms.items()},
        drives,
        MazeClient,
        logs,
    )


def drive_policies(
    graph: Sequence[Executable],
    arms: Mapping[ArmT, Parameters],
    drives: Sequence[Callable[[ClientT], OutcomeT]],
    client_type: Callable[[Callable[[], None]], ClientT],
    logs: Path,
) -> dict[ArmT, list[OutcomeT]]:
    """Outcome of every drive by arm, from processes that talk over DDS.

    Args:
        graph: Every process but that of the policy.
        arms: Parameters of policy_node by arm.
        drives: What to do with each arm.
        client_type: Makes the client, which calls what it is given while it waits.
        logs: Folder for what the nodes print.

    Raises:
        NodeFailedError: If a node ends; with its log.
        NoAnswerError: If a node does not answer in time; with all logs.
    """
    outcomes: dict[ArmT, list[OutcomeT]] = {}
    with ExitStack() as stack:
        stack.enter_context(own_domain())
        nodes = [
            stack.enter_context(NodeProcess(name, given, logs / f'{name}.log', package=package))
            for name, given, package in graph
        ]
        rclpy.init()
        stack.callback(rclpy.try_shutdown)
        bar = stack.enter_context(tqdm(total=len(arms) * len(drives), unit='goal', desc='drive'))
        for number, (arm, given) in enumerate(arms.items()):
            with NodeProcess('policy_node', given, logs / f'policy_node_{number}.log') as policy:
                running = [*nodes, policy]
                client = client_type(partial(check, running))
                try:
                    client.wait_until_ready(START_TIMEOUT_S)
                    outcomes[arm] = []
                    for drive in drives:
                        outcomes[arm].append(drive(client))
                        bar.update()
                except NoAnswerError as error:
                    logs_seen = (node.describe('still runs') for node in running)
                    raise NoAnswerError('\n'.join([str(error), *logs_seen])) from error
                client.destroy_node()
    return outcomes


def check(nodes: Sequence[NodeProcess]) -> None:
    """Raise if a node has died."""
    for node in nodes:
        node.check()


@contextmanager
def own_domain() -> Iterator[None]:
    """A ROS domain that no other program on this machine uses, unless one is set already."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    if 'ROS_DOMAIN_ID' in os.environ:
        yield
        return
    # Left by hand: its own `with` block would take an OSError from the body for a taken domain.
    reservation = domain_id()
    os.environ['ROS_DOMAIN_ID'] = str(reservation.__enter__())
    try:
        yield
    finally:
        del os.environ['ROS_DOMAIN_ID']
        reservation.__exit__(None, None, None)
