"""One adapter for many robots: how long an expert takes, what is refused and what is lost."""

from __future__ import annotations

from contextlib import closing, ExitStack
from itertools import groupby
import multiprocessing
from operator import itemgetter
import os
from pathlib import Path
import tempfile
from typing import Any, TYPE_CHECKING

from metagcttt_core import TrajectoryDataset
from metagcttt_core.agents import AgentName
from metagcttt_core.config import assets_dir
import numpy as np
from pydantic import Field
from tqdm import tqdm

from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report

if TYPE_CHECKING:
    from metagcttt.deployment import Deployment

    from metagcttt_tools.benchmarks.fleet_robot import Outcome

_NUM_GOALS = 10
_GOAL_STEPS = 100  # from start to goal

_DESCRIPTION = """One adapter for many robots: how long an expert takes, what is refused and lost.

Example: metagcttt benchmark adapter
Prints a table and writes JSON."""


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    parse(AdapterBenchmark, _DESCRIPTION, 'benchmark adapter', argv).run()


class AdapterBenchmark(Benchmark):
    """From a robot's request to its expert: one robot, many, and more than the adapter can serve.

    Robots and adapter are processes of their own; robots repeat an unanswered request once a
    second, as policy nodes do. Every expert is compared with that of adapting here, bit by bit.
    """

    out: Path = Field(Path('out/benchmark/adapter'), description='folder for results and log')
    robots: int = Field(20, ge=1, description='robots that ask')
    duration_s: float = Field(80.0, gt=0, description='of each of the three stretches, seconds')
    goal_every_s: float = Field(20.0, gt=0, description='from one goal of a robot to the next')
    rush_every_s: float = Field(
        0.2, gt=0, description='the same in the third stretch, which the adapter cannot serve'
    )
    workers: int = Field(2, ge=1, description='workers of the adapter')
    rush_queue: int = Field(
        4, ge=0, description='queue of the adapter in the third stretch; else it has every robot'
    )
    agent: AgentName = Field('gcbc', description='kind of policy')
    hidden: tuple[int, ...] = Field((512, 512, 512), description='units of its networks')
    steps: int = Field(10, ge=1, le=1000, description='K: gradient steps per goal')
    batch_size: int = Field(256, ge=1, le=4096, description='transitions per gradient step')
    timeout_s: float = Field(60.0, gt=0, description='an expert is lost after so long, seconds')
    seed: int = Field(0, ge=0, description='of weights, states and goals')

    def run(self) -> None:
        """Measure, print and write.

        Raises:
            NodeFailedError: If the adapter ends by itself.
        """
        from metagcttt.deployment import load_deployment
        from metagcttt_core import FilterConfig, make_agent, save_checkpoint

        from metagcttt_tools.graph.drive import own_domain

        dataset = assets_dir() / 'pointmaze-medium-navigate' / 'dataset.npz'
        loads = [os.getloadavg()[0]]
        with tempfile.TemporaryDirectory() as folder, own_domain():
            data = TrajectoryDataset.load(dataset)
            agent = make_agent(
                self.agent,
                obs_dim=data.obs_dim,
                act_dim=data.act_dim,
                hidden=self.hidden,
                seed=self.seed,
            )
            save_checkpoint(agent, Path(folder) / 'policy')
            filter_config = FilterConfig(variant='gcttt')
            deployment = load_deployment(f'{folder}/policy', str(dataset), filter_config)
            requests, digests = self._goals(deployment)
            outcomes = self._stretches(folder, requests)
        loads.append(os.getloadavg()[0])
        rows = [self._row(*stretch, digests) for stretch in outcomes]
        reasons = sorted({o.reason for *_, found in outcomes for o in found if o.reason})
        results = {
            'stretches': rows,
            'reasons': reasons[:20],
            'cores_usable': len(os.sched_getaffinity(0)),
            'load_before_and_after': loads,
        }
        write_report(self.out / 'adapter.json', self, results)
        print(f'{results["cores_usable"]} cores, load {loads[0]:.1f} before, {loads[1]:.1f} after')
        print(markdown_table(rows))
        print(f'results: {self.out / "adapter.json"}')

    def _goals(self, deployment: Deployment) -> tuple[list[bytes], list[str]]:
        """Serialized requests, and the digests of the experts that they must come to."""
        from metagcttt.adaptation_messages import request_message
        from metagcttt.deployment import adapt_to_goal
        from metagcttt.goal_in_force import Goal
        from metagcttt_core import TTTConfig
        from metagcttt_core.adaptation.weights import changed_weights
        from rclpy.serialization import serialize_message

        from metagcttt_tools.benchmarks.fleet_robot import digest_of

        rng = np.random.default_rng(self.seed)
        dataset, agent = deployment.dataset, deployment.agent
        config = TTTConfig(steps=self.steps, batch_size=self.batch_size)
        requests, digests = [], []
        for number in range(_NUM_GOALS):
            # Two states of one trajectory, so that there are data to adapt on.
            episode = rng.integers(dataset.num_episodes)
            first, last = dataset.episode_starts[episode], dataset.episode_ends[episode]
            row = int(rng.integers(first, max(first + 1, last - _GOAL_STEPS)))
            rows = row, min(row + _GOAL_STEPS, int(last))
            start, end = (np.asarray(dataset.states(each), np.float64) for each in rows)
            goal = Goal(number, 1, end, (0.0, 0.0), seed=self.seed + number)
            request = request_message(
                robot='',
                instance=1,
                request_id=0,
                timeout_s=self.timeout_s,
                identity=deployment.identity,
                observation=start,
                goal=goal,
                config=config,
            )
            requests.append(serialize_message(request))
            adaptation = adapt_to_goal(deployment, start, goal, config, lambda: False)
            digests.append(digest_of(changed_weights(agent, adaptation.agent)))
        return requests, digests

    def _stretches(
        self, folder: str, requests: list[bytes]
    ) -> list[tuple[int, float, int, list[Outcome]]]:
        """For each stretch: robots, seconds between goals, queue and outcomes."""
        from metagcttt_tools.benchmarks.fleet_robot import Drive, drive
        from metagcttt_tools.graph.process import NodeProcess

        plan = [
            (1, self.goal_every_s, self.robots),
            (self.robots, self.goal_every_s, self.robots),
            (self.robots, self.rush_every_s, self.rush_queue),
        ]
        found: list[tuple[int, float, int, list[Outcome]]] = []
        context = multiprocessing.get_context('spawn')
        with ExitStack() as stack, tqdm(total=len(plan), unit='stretch') as bar:
            ends = []
            for number in range(self.robots):
                own, other = context.Pipe()
                name = f'robot_{number}'
                robot = context.Process(
                    target=drive, args=(name, requests, self.timeout_s, other), daemon=True
                )
                robot.start()
                other.close()
                stack.callback(robot.join)
                ends.append(own)
            for end in ends:
                stack.enter_context(closing(end))
            for queue, stretches in groupby(plan, key=itemgetter(2)):
                parameters: dict[str, bool | int | float | str] = {
                    'checkpoint': f'{folder}/policy',
                    'workers': self.workers,
                    'queue': queue,
                    'threads': 1,
                }
                log = self.out / f'adapter_node_{queue}.log'
                with NodeProcess('adapter_node', parameters, log) as adapter:
                    for robots, every_s, _ in stretches:
                        for number, end in enumerate(ends[:robots]):
                            offset_s = every_s * number / robots
                            end.send(Drive(self.duration_s, every_s, offset_s))
                        outcomes = [outcome for end in ends[:robots] for outcome in end.recv()]
                        adapter.check()
                        found.append((robots, every_s, queue, outcomes))
                        bar.update()
        return found

    def _row(
        self,
        robots: int,
        every_s: float,
        queue: int,
        outcomes: list[Outcome],
        digests: list[str],
    ) -> dict[str, Any]:
        of_kind = {
            kind: [outcome for outcome in outcomes if outcome.kind == kind]
            for kind in ('expert', 'refused', 'failed', 'lost')
        }
        experts = of_kind['expert']
        return {
            'robots': robots,
            'a goal every (s)': every_s,
            'queue': queue,
            'requests': len(outcomes),
            'experts': len(experts),
            'refused': len(of_kind['refused']),
            'failed': len(of_kind['failed']),
            'lost': len(of_kind['lost']),
            'repeated': sum(outcome.unanswered for outcome in outcomes),
            'other bits': sum(digests[each.goal] != each.digest for each in experts),
            'median (ms)': percentile([each.milliseconds for each in experts], 50),
            'p99 (ms)': percentile([each.milliseconds for each in experts], 99),
            'in the queue, p99 (ms)': percentile([each.wait_ms for each in experts], 99),
            'refusal, p99 (ms)': percentile([o.milliseconds for o in of_kind['refused']], 99),
        }


def percentile(values: list[float], percent: float) -> float | str:
    """The percentile of the values; `none` when there are none."""
    return float(np.percentile(values, percent)) if values else 'none'
