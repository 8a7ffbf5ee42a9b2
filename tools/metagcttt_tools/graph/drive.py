"""Simulator, goal node and one policy after another as processes, driven in lockstep."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
from functools import partial
import os
from pathlib import Path
from typing import TypeVar

from domain_coordinator import domain_id
from metagcttt.commander import NoAnswerError
import rclpy
from tqdm import tqdm

from metagcttt_tools.graph.client import GoalOutcome, MazeClient
from metagcttt_tools.graph.process import NodeProcess

Parameters = Mapping[str, bool | int | float | str]
Drive = Callable[[MazeClient], GoalOutcome]
ArmT = TypeVar('ArmT')

START_TIMEOUT_S = 30.0
_LOCKSTEP = {'stepping': 'lockstep'}


def drive_arms(
    arms: Mapping[ArmT, Parameters],
    drives: Sequence[Drive],
    *,
    logs: Path,
    simulator: Parameters | None = None,
    goal_node: Parameters | None = None,
) -> dict[ArmT, list[GoalOutcome]]:
    """Outcome of every drive by arm, from three processes that talk over DDS.

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
    outcomes: dict[ArmT, list[GoalOutcome]] = {}
    with ExitStack() as stack:
        stack.enter_context(own_domain())
        nodes = [
            stack.enter_context(NodeProcess(name, {**_LOCKSTEP, **given}, logs / f'{name}.log'))
            for name, given in (
                ('sim_bridge_node', simulator or {}),
                ('goal_node', goal_node or {}),
            )
        ]
        rclpy.init()
        stack.callback(rclpy.try_shutdown)
        bar = stack.enter_context(tqdm(total=len(arms) * len(drives), unit='goal', desc='drive'))
        for number, (arm, given) in enumerate(arms.items()):
            parameters = {'adaptation': 'hold', **_LOCKSTEP, **given}
            log = logs / f'policy_node_{number}.log'
            with NodeProcess('policy_node', parameters, log) as policy:
                running = [*nodes, policy]
                client = MazeClient(partial(check, running))
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
