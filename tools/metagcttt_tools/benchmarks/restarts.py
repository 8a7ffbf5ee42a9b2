"""The three nodes killed and started again, and ended by a signal: how long each takes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
import os
from pathlib import Path
import signal
import time
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field
from tqdm import tqdm

from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report

if TYPE_CHECKING:
    from metagcttt.commander import RobotCommander, SentGoal

    from metagcttt_tools.graph.process import NodeProcess

_GOAL = (20.0, 20.0)
_ENDLESS_STEPS = 10000
_NODES: dict[str, dict[str, bool | int | float | str]] = {
    'sim_bridge_node': {},
    'goal_node': {},
    'policy_node': {'adapt_steps': 5},
}


_DESCRIPTION = """How long the three nodes take to start again and to end.

Example: metagcttt benchmark restarts
Prints a table and writes JSON."""


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    parse(RestartsBenchmark, _DESCRIPTION, 'benchmark restarts', argv).run()


class RestartsBenchmark(Benchmark):
    """From the start of a killed node's successor to an expert's action, and from signal to exit.

    Simulator, goal node and policy node are processes of their own, on the committed maze, dataset
    and policy. The policy ends in the middle of an adaptation.
    """

    out: Path = Field(Path('out/benchmark/restarts'), description='folder for results and logs')
    repeats: int = Field(3, ge=1, description='restarts, and ends by a signal, per node')
    timeout_s: float = Field(60.0, gt=0, description='longest wait for service, seconds')

    def run(self) -> None:
        """Measure, print and write.

        Raises:
            NodeFailedError: If a node ends by itself, or by an exit status other than 0.
            NoAnswerError: If a node does not serve in time.
        """
        from metagcttt.commander import RobotCommander
        import rclpy

        from metagcttt_tools.graph.drive import own_domain

        load = os.getloadavg()[0]
        with own_domain(), ExitStack() as stack, tqdm(total=2 * self.repeats, unit='round') as bar:
            rclpy.init()
            stack.callback(rclpy.try_shutdown)
            commander = RobotCommander()
            stack.callback(commander.destroy_node)
            restarts, ends = [], []
            for _ in range(self.repeats):
                restarts.append(self._restart_each(commander))
                bar.update()
                ends.append(self._end_each(commander))
                bar.update()
        rows = [
            {
                'node': name,
                'restart (s)': float(np.median([row[name] for row in restarts])),
                'longest': max(row[name] for row in restarts),
                'end (s)': float(np.median([row[name] for row in ends])),
                'longest end': max(row[name] for row in ends),
            }
            for name in _NODES
        ]
        loads = [load, os.getloadavg()[0]]
        results = {'seconds': rows, 'load_before_and_after': loads}
        write_report(self.out / 'restarts.json', self, results)
        print(f'load {loads[0]:.1f} before and {loads[1]:.1f} after')
        print(markdown_table(rows))
        print(f'results: {self.out / "restarts.json"}')

    def _restart_each(self, commander: RobotCommander) -> dict[str, float]:
        """Seconds from the start of its process to an expert's action, by node."""
        seconds = {}
        with ExitStack() as stack:
            nodes = {name: self._start(stack, name) for name in _NODES}
            drive(commander, self.timeout_s)
            for name in _NODES:
                nodes[name].kill()
                began = time.monotonic()
                nodes[name] = self._start(stack, name)
                drive(commander, self.timeout_s)
                seconds[name] = time.monotonic() - began
        return seconds

    def _end_each(self, commander: RobotCommander) -> dict[str, float]:
        """Seconds from Ctrl-C to the end of the process, by node; the policy is adapting."""
        from metagcttt_tools.graph.process import NodeFailedError

        seconds = {}
        with ExitStack() as stack:
            nodes = {name: self._start(stack, name) for name in ('sim_bridge_node', 'goal_node')}
            policy = self._start(stack, 'policy_node', adapt_steps=_ENDLESS_STEPS)
            drive(commander, self.timeout_s, until=_is_adapting)
            for name, node in {'policy_node': policy, **nodes}.items():
                began = time.monotonic()
                status = node.stop(signal_number=signal.SIGINT)
                seconds[name] = time.monotonic() - began
                if status:
                    raise NodeFailedError(node.describe(f'ended with status {status}'))
        return seconds

    def _start(self, stack: ExitStack, name: str, **parameters: int) -> NodeProcess:
        from metagcttt_tools.graph.process import NodeProcess

        log = self.out / f'{name}.log'
        return stack.enter_context(NodeProcess(name, {**_NODES[name], **parameters}, log))


def _is_adapted(sent: SentGoal) -> bool:
    return sent.feedback is not None and sent.feedback.adapted


def _is_adapting(sent: SentGoal) -> bool:
    from metagcttt_interfaces.action import ReachGoal

    return sent.feedback is not None and sent.feedback.phase == ReachGoal.Feedback.ADAPTING


def drive(
    commander: RobotCommander,
    timeout_s: float,
    until: Callable[[SentGoal], bool] = _is_adapted,
) -> None:
    """Send goals until one is driven to by the adapted policy.

    Raises:
        NoAnswerError: If none is within `timeout_s`.
    """
    from metagcttt.commander import NoAnswerError

    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        try:
            # The start of a task is a place where the dataset has trajectories.
            commander.set_task(1, timeout_s=1.0)
            sent = commander.send(_GOAL, timeout_s=1.0)
            end = min(time.monotonic() + 2.0, deadline)
            while not sent.is_done() and time.monotonic() < end:
                if until(sent):
                    return
        except NoAnswerError:
            continue  # a request to a node that was killed is lost
    raise NoAnswerError(f'no goal was driven to within {timeout_s:g} s')
