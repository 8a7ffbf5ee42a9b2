"""Cost of a step of the inner loop: engines and precisions beside bare products and JAX."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
import os
from pathlib import Path
import time
from typing import Any, TYPE_CHECKING

from metagcttt_core.agents.config import GCIQLSettings
import numpy as np
from pydantic import Field, field_validator
from tqdm import tqdm

from metagcttt_tools.benchmarks.jax_scan import jax_inner_loop
from metagcttt_tools.benchmarks.training import (
    Learner,
    LEARNERS,
    products_of,
    random_batch,
    Size,
    times_ms,
    update_of,
)
from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from metagcttt_core import Agent

_DESCRIPTION = """Cost of an inner step: engines and precisions, bare products and JAX.

Example: metagcttt benchmark inner-loop
Prints a table, draws it and writes JSON; with one thread, in processor time. JAX takes the extra
`jax`, and steps GCBC and GCIQL with ddpgbc."""
_LR = 3e-4


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    parse(InnerLoopBenchmark, _DESCRIPTION, 'benchmark inner-loop', argv).run()


class InnerLoopBenchmark(Benchmark):
    """Milliseconds per inner step, all ways in turn, so that a slow spell meets them all."""

    out: Path = Field(Path('out/benchmark/inner-loop.json'), description='file for the results')
    sizes: tuple[tuple[int, int, int], ...] = Field(
        ((512, 3, 1024), (512, 3, 256), (256, 3, 256), (128, 3, 256), (128, 3, 64)),
        description='units, hidden layers and batch size of each measurement',
    )
    agents: tuple[str, ...] = Field(
        tuple(map(str, LEARNERS)), min_length=1, description='agents, with their actor loss'
    )
    steps: int = Field(20, ge=1, description='inner steps K')
    test_rows: int = Field(128, ge=1, description='transitions in the test batch')
    threads: int = Field(1, ge=1, description='threads for tensor operations')
    repeats: int = Field(9, ge=3, description='inner loops per measurement, of which the median')

    @field_validator('agents')
    @classmethod
    def _known(cls, agents: tuple[str, ...]) -> tuple[str, ...]:
        known = list(map(str, LEARNERS))
        for name in agents:
            if name not in known:
                raise ValueError(f'must be of {", ".join(known)}, got {name}')
        return agents

    def run(self) -> None:
        """Measure, print and write."""
        # Read when JAX starts.
        single = '--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1'
        if self.threads == 1:
            os.environ.setdefault('XLA_FLAGS', single)
        import torch

        from metagcttt_tools.common.plots import save

        torch.set_num_threads(self.threads)
        learners = [learner for learner in LEARNERS if str(learner) in self.agents]
        cases = [(learner, Size(*size)) for learner in learners for size in self.sizes]
        rows = [self._row(*case) for case in tqdm(cases, unit='row', desc='inner loop')]
        write_report(self.out, self, {'load': os.getloadavg(), 'ms_per_step': rows})
        save(picture(rows), self.out.with_suffix('.png'))
        print('Milliseconds per inner step (medians):\n' + markdown_table(rows))
        print(f'results: {self.out}\npicture: {self.out.with_suffix(".png")}')

    def _row(self, learner: Learner, size: Size) -> dict[str, Any]:
        from metagcttt_core import make_agent
        from metagcttt_core.adaptation.inner_loop import run_inner_loop
        from metagcttt_core.agents.passes import product

        agent = make_agent(
            learner.agent,
            obs_dim=2,
            act_dim=2,
            hidden=(size.units,) * size.layers,
            **learner.settings,
        )
        batches = [random_batch(agent, size.batch)] * self.steps
        test_batch = random_batch(agent, self.test_rows)
        adapt = partial(run_inner_loop, agent, batches, lr=_LR)
        written_out = agent.analytic_loss() is not None
        products = products_of(update_of(agent.clone(), batches[0], 'float32', compiled=False))
        ways: dict[str, Callable[[], Any]] = {
            'eager': adapt,
            'analytic': partial(adapt, engine='analytic' if written_out else 'eager'),
            'auto': partial(adapt, engine='auto'),
            'bfloat16': partial(adapt, engine='auto', precision='bfloat16'),
            'early stopping': partial(adapt, engine='auto', test_batch=test_batch),
            'products': lambda: [
                product(a, b.t()) for _ in range(self.steps) for a, b in products
            ],
        }
        if find_spec('jax') and str(learner) in ('gcbc', 'gciql ddpgbc'):
            ways['jax'] = _in_jax(agent, batches)
        engine = adapt(engine='auto').engine
        # In processor time, what others do on the machine meanwhile does not count.
        clock = time.process_time if self.threads == 1 else time.perf_counter
        times = {
            name: [ms / self.steps for ms in taken]
            for name, taken in times_ms(ways, self.repeats, clock).items()
        }

        def ratio(way: str, other: str) -> float | str:
            """The median over the rounds, in which both ran one after the other."""
            if other not in times:
                return ''
            return float(np.median(np.divide(times[way], times[other])))

        return {
            'agent': str(learner),
            'hidden': f'{size.units} x {size.layers}',
            'batch': size.batch,
            'engine': engine,
            **{name: float(np.median(taken)) for name, taken in times.items()},
            'jax': float(np.median(times['jax'])) if 'jax' in times else '',
            'eager / auto': ratio('eager', 'auto'),
            'auto / jax': ratio('auto', 'jax'),
            'auto / products': ratio('auto', 'products'),
            'bfloat16 / jax': ratio('bfloat16', 'jax'),
        }


def _in_jax(agent: Agent, batches: list[dict[str, Any]]) -> Callable[[], list[float]]:
    stacked = {key: np.stack([batch[key].numpy() for batch in batches]) for key in batches[0]}
    settings = agent.settings if isinstance(agent.settings, GCIQLSettings) else None
    return jax_inner_loop(agent.export_reference_parameters(), stacked, _LR, settings)


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Milliseconds per step by engine, each agent and size in units of the eager engine."""
    from matplotlib.figure import Figure

    from metagcttt_tools.common.plots import COLORS

    ways = ('analytic', 'jax', 'auto', 'bfloat16')
    figure = Figure(figsize=(7, 0.5 + 0.45 * len(rows)), layout='constrained')
    axes = figure.subplots()
    height = 0.8 / len(ways)
    for color, (place, way) in zip(COLORS, enumerate(ways), strict=False):
        shown = [(line, row[way] / row['eager']) for line, row in enumerate(rows) if row[way]]
        axes.barh(
            [line + (place - 1.5) * height for line, _ in shown],
            [share for _, share in shown],
            height,
            color=color,
            label=way,
        )
    axes.set_yticks(
        range(len(rows)), [f'{row["agent"]}, {row["hidden"]}, {row["batch"]}' for row in rows]
    )
    axes.invert_yaxis()
    axes.axvline(1, color='black', linewidth=0.8)
    axes.set_xlabel('time of an inner step, in that of the eager engine')
    axes.legend(loc='upper left', bbox_to_anchor=(1, 1))
    return figure
