"""The policy node over DDS: latency, deadlines and the time a goal costs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import cycle
import os
from pathlib import Path
import tempfile
from typing import Any, Literal, TYPE_CHECKING

from metagcttt_core import TrajectoryDataset
from metagcttt_core.agents import AgentName
from metagcttt_core.config import assets_dir
import numpy as np
from pydantic import Field
from tqdm import tqdm

from metagcttt_tools.benchmarks.audience import Audience, watching
from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report

if TYPE_CHECKING:
    from metagcttt_tools.benchmarks.state_source import Answers, StateSource

_ENDLESS_STEPS = 10000
_WARM_UP_S = 2.0
_AUDIENCE_ARRIVES_S = 5.0  # a page loads the scene


_DESCRIPTION = """The policy node over DDS: latency, deadlines and the time a goal costs.

Example: metagcttt benchmark ros
Prints a table and writes JSON."""


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    parse(RosBenchmark, _DESCRIPTION, 'benchmark ros', argv).run()


class RosBenchmark(Benchmark):
    """Latency of policy_node, idle and while adapting, and the time from goal to adapted action.

    A program in the place of the simulator publishes states at a fixed rate to a policy_node in
    a process of its own; a deadline is missed when a state has no action as the next one is due.
    """

    out: Path = Field(Path('out/benchmark/ros'), description='folder for results and node log')
    duration_s: float = Field(180.0, gt=0, description='of the stretch under adaptation, seconds')
    idle_s: float = Field(30.0, gt=0, description='of the stretch without adaptation, seconds')
    goal_every_s: float = Field(
        2.0, gt=0, description='while adapting, a new goal supersedes the last, seconds'
    )
    rate_hz: float = Field(50.0, gt=0, le=1000, description='states per second')
    agent: AgentName = Field('gcbc', description='kind of policy')
    hidden: tuple[int, ...] = Field((512, 512, 512), description='units of its networks')
    steps: tuple[int, ...] = Field((1, 10, 50, 100), description='K: gradient steps per goal')
    repeats: int = Field(5, ge=1, description='goals per K')
    timeout_s: float = Field(60.0, gt=0, description='longest wait for an expert, seconds')
    stepping: Literal['realtime', 'lockstep'] = Field(
        'realtime', description='stepping of the policy node'
    )
    audience: Audience = Field(
        'none',
        description='who looks at the live view meanwhile, in every second stretch: a reader, '
        'which takes what a page gets, or a browser, a headless Chromium at low priority',
    )
    turns: int = Field(1, ge=1, description='stretches under adaptation, each with and without')
    seed: int = Field(0, ge=0, description='of weights, states and goals')

    def run(self) -> None:
        """Measure, print and write."""
        from metagcttt_core import make_agent, save_checkpoint
        import rclpy

        from metagcttt_tools.benchmarks.state_source import StateSource
        from metagcttt_tools.graph.drive import own_domain
        from metagcttt_tools.graph.process import NodeProcess

        dataset = TrajectoryDataset.load(
            assets_dir() / 'pointmaze-medium-navigate' / 'dataset.npz'
        )
        load = os.getloadavg()[0]
        rng = np.random.default_rng(self.seed)
        goals = dataset.observations[rng.integers(dataset.num_rows, size=1000)]
        agent = make_agent(
            self.agent,
            obs_dim=dataset.obs_dim,
            act_dim=dataset.act_dim,
            hidden=self.hidden,
            seed=self.seed,
        )
        with tempfile.TemporaryDirectory() as folder, own_domain():
            save_checkpoint(agent, Path(folder) / 'policy')
            parameters: dict[str, bool | int | float | str] = {
                'checkpoint': f'{folder}/policy',
                'stepping': self.stepping,
                'rate_hz': self.rate_hz,
                'threads': 1,
            }
            log = self.out / 'policy_node.log'
            with NodeProcess('policy_node', parameters, log) as policy:
                rclpy.init()
                source = StateSource(dataset.observations[:1000], self.rate_hz, policy.check)
                source.wait_until_ready(self.timeout_s)
                latency = self._latency(source, goals)
                fresh = cycle(goals[::-1])  # new ones, which no cache of experts knows
                goal_cost = [self._goal_cost(source, fresh, steps) for steps in self.steps]
                source.destroy_node()
                rclpy.try_shutdown()
        results = {
            'latency': latency,
            'goal_to_action': goal_cost,
            # Other programs decide about the tail of the latency.
            'cores_usable': len(os.sched_getaffinity(0)),
            'load_before_and_after': [load, os.getloadavg()[0]],
        }
        write_report(self.out / 'ros.json', self, results)
        print(
            f'{results["cores_usable"]} cores, load {load:.1f} before and '
            f'{os.getloadavg()[0]:.1f} after'
        )
        print(f'States at {self.rate_hz:g} Hz (ms):\n' + markdown_table(latency))
        print('From a goal to its actions (ms, medians):\n' + markdown_table(goal_cost))
        print(f'results: {self.out / "ros.json"}')

    def _latency(self, source: StateSource, goals: np.ndarray) -> list[dict[str, Any]]:
        source.configure_policy(adapt_steps=1, adaptation='async')
        source.play(_WARM_UP_S)
        source.send_goal(goals[0], self.seed)
        source.play(_WARM_UP_S)
        idle = self._row('idle', source.play(self.idle_s), source)
        source.configure_policy(adapt_steps=_ENDLESS_STEPS)
        rows, rest = [idle], cycle(goals[1:])
        for _ in range(self.turns):
            rows.append(self._row('adapting', self._adapting(source, rest), source))
            if self.audience != 'none':
                with watching(self.audience, self.out):
                    source.play(_AUDIENCE_ARRIVES_S)
                    answers = self._adapting(source, rest)
                rows.append(self._row(f'adapting, {self.audience}', answers, source))
        return rows

    def _adapting(self, source: StateSource, goals: Iterator[np.ndarray]) -> Answers:
        """Play states while the policy adapts to one goal after the other."""
        due_s = 0.0
        seconds = round(self.duration_s)
        bar = tqdm(total=seconds, unit='s', desc='adapting')

        def supersede(elapsed_s: float) -> None:
            nonlocal due_s
            if elapsed_s >= due_s:
                source.send_goal(next(goals), self.seed)
                due_s += self.goal_every_s
                bar.update(min(round(due_s), seconds) - bar.n)

        with bar:
            return source.play(self.duration_s, every=supersede)

    def _row(self, name: str, answers: Answers, source: StateSource) -> dict[str, Any]:
        latencies = answers.latencies_ms()
        return {
            'policy': name,
            'states': len(answers.sent),
            'median': float(np.median(latencies)),
            'p99': float(np.percentile(latencies, 99)),
            'maximum': float(latencies.max()),
            'missed deadlines': answers.missed(source.period_s),
        }

    def _goal_cost(
        self, source: StateSource, goals: Iterator[np.ndarray], steps: int
    ) -> dict[str, Any]:
        """Times from a goal to actions for it, acting meanwhile (async) and waiting (hold)."""
        row: dict[str, Any] = {'K': steps, 'without an expert': 0}
        for mode in ('async', 'hold'):
            source.configure_policy(adapt_steps=steps, adaptation=mode)
            serving, adapted, filtering, inner = [], [], [], []
            for _ in range(self.repeats):
                number, sent = source.send_goal(next(goals), self.seed)
                answers = source.play(
                    self.timeout_s, until=partial(self._has_expert, source, number)
                )
                if number not in answers.adapted:
                    row['without an expert'] += 1
                    continue
                serving.append(1e3 * (answers.serving[number] - sent))
                adapted.append(1e3 * (answers.adapted[number] - sent))
                report = next((r for r in answers.reports if r.query_id == number), None)
                if report is not None:
                    filtering.append(report.filter_ms)
                    inner.append(report.adapt_ms)
            row[f'{mode}: first action'] = _median(serving)
            row[f'{mode}: first adapted'] = _median(adapted)
            if mode == 'async':
                row['filter'], row['inner loop'] = _median(filtering), _median(inner)
        return row

    @staticmethod
    def _has_expert(source: StateSource, number: int) -> bool:
        return number in source.seen.adapted


def _median(values: list[float]) -> float | str:
    return float(np.median(values)) if values else 'none'
