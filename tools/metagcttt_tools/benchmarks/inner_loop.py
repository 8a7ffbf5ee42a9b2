"""Cost of a step of the inner loop: engines and precisions beside bare products and JAX."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from pydantic import Field
from tqdm import tqdm

from metagcttt_tools.benchmarks.jax_scan import jax_inner_loop
from metagcttt_tools.benchmarks.training import (
    Learner,
    LEARNERS,
    median_ms,
    products_of,
    random_batch,
    Size,
    update_of,
)
from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report

if TYPE_CHECKING:
    from metagcttt_core import Agent

_DESCRIPTION = """Cost of an inner step: engines and precisions, bare products and JAX.

Example: metagcttt benchmark inner-loop
Prints a table and writes JSON. JAX takes the extra `jax`, and steps GCBC alone."""
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
    steps: int = Field(20, ge=1, description='inner steps K')
    test_rows: int = Field(128, ge=1, description='transitions in the test batch')
    threads: int = Field(1, ge=1, description='threads for tensor operations')
    repeats: int = Field(9, ge=3, description='inner loops per measurement, of which the median')

    def run(self) -> None:
        """Measure, print and write."""
        # Read when JAX starts.
        single = '--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1'
        if self.threads == 1:
            os.environ.setdefault('XLA_FLAGS', single)
        import torch

        torch.set_num_threads(self.threads)
        cases = [(learner, Size(*size)) for learner in LEARNERS for size in self.sizes]
        rows = [self._row(*case) for case in tqdm(cases, unit='row', desc='inner loop')]
        write_report(self.out, self, {'ms_per_step': rows})
        print('Milliseconds per inner step (medians):\n' + markdown_table(rows))
        print(f'results: {self.out}')

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
        products = products_of(update_of(agent.clone(), batches[0], 'float32', compiled=False))
        ways: dict[str, Callable[[], Any]] = {
            'eager': adapt,
            'analytic': partial(adapt, engine='auto'),
            'bfloat16': partial(adapt, engine='auto', precision='bfloat16'),
            'early stopping': partial(adapt, engine='auto', test_batch=test_batch),
            'products': lambda: [
                product(a, b.t()) for _ in range(self.steps) for a, b in products
            ],
        }
        if find_spec('jax') and learner.agent == 'gcbc':
            ways['jax'] = _in_jax(agent, batches)
        times = {name: ms / self.steps for name, ms in median_ms(ways, self.repeats).items()}
        jax = times.pop('jax', None)
        return {
            'agent': str(learner),
            'hidden': f'{size.units} x {size.layers}',
            'batch': size.batch,
            **times,
            'eager / analytic': times['eager'] / times['analytic'],
            'analytic / products': times['analytic'] / times['products'],
            'jax': '' if jax is None else jax,
            'analytic / jax': '' if jax is None else times['analytic'] / jax,
            'bfloat16 / jax': '' if jax is None else times['bfloat16'] / jax,
        }


def _in_jax(agent: Agent, batches: list[dict[str, Any]]) -> Callable[[], list[float]]:
    exported = agent.export_reference_parameters()
    layers = sorted({name.rpartition('.')[0] for name in exported})  # actor.fc0 ... actor.mean
    weights = [exported[f'{layer}.{kind}'] for layer in layers for kind in ('kernel', 'bias')]

    def stacked(*keys: str) -> np.ndarray:
        return np.stack(
            [np.concatenate([batch[key].numpy() for key in keys], axis=-1) for batch in batches]
        )

    return jax_inner_loop(weights, stacked('observations', 'actor_goals'), stacked('actions'), _LR)
