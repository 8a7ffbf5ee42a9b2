"""Cost of filtering: the index against a scan of the dataset, without and with a critic."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import time
from typing import Any, TYPE_CHECKING

from metagcttt_core import TrajectoryDataset, TrajectoryFilter
from metagcttt_core.agents.config import GCIQLSettings
import numpy as np
from pydantic import Field
from sim_bridge.generation.behaviours import Kind
from sim_bridge.generation.generate import generate
from sim_bridge.generation.plan import plan_dataset
from tqdm import tqdm

from metagcttt_tools.benchmarks.scan import scan
from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ENVIRONMENT = 'pointmaze-medium-v0'
_JITTER_M = 0.05


_DESCRIPTION = """Cost of filtering: the index against a scan, without and with a critic.

Example: metagcttt benchmark retrieval
Prints a table and writes JSON."""


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    parse(RetrievalBenchmark, _DESCRIPTION, 'benchmark retrieval', argv).run()


class RetrievalBenchmark(Benchmark):
    """Filter cost on point maze data of OGBench's size (kept in DATA) and ten times it."""

    data: Path = Field(Path('data'), description='folder of the generated datasets')
    out: Path = Field(Path('out/benchmark/retrieval'), description='folder for results and plot')
    queries: int = Field(100, ge=5, description='critic-free queries per dataset')
    goals: int = Field(5, ge=1, description='goals of the critic-based measurement')
    hidden: tuple[int, ...] = Field((512, 512, 512), description='units of the value network')
    seed: int = Field(0, ge=0, description='of queries and weights')

    def run(self) -> None:
        """Measure, print and write."""
        import torch

        from metagcttt_tools.common.plots import save

        torch.set_num_threads(1)
        critic_free, critic_based = [], []
        for kind in ('navigate', 'stitch'):
            dataset = self._dataset(kind)
            critic_free.append(self._critic_free(kind, dataset))
            critic_based.append(self._critic_based(kind, dataset))
            critic_free.append(self._critic_free(f'{kind} x 10', enlarged(dataset, 10, self.seed)))
        navigate = self._dataset('navigate')
        sizes = [
            self._critic_free(f'navigate x {factor:g}', enlarged(navigate, factor, self.seed))
            for factor in (0.1, 0.3, 1, 3, 10)
        ]
        save(cost_picture(sizes), self.out / 'cost.png')
        write_report(
            self.out / 'retrieval.json',
            self,
            {'critic_free': critic_free, 'critic_based': critic_based, 'sizes': sizes},
        )
        print('Without a critic (times in ms, medians):\n' + markdown_table(critic_free))
        print('With a critic (times in ms, medians):\n' + markdown_table(critic_based))
        print(f'results: {self.out / "retrieval.json"}\npicture: {self.out / "cost.png"}')

    def _dataset(self, kind: Kind) -> TrajectoryDataset:
        plan = plan_dataset(_ENVIRONMENT, kind)
        path = self.data / f'pointmaze-medium-{kind}-v0.npz'
        if not path.with_suffix('.json').exists():
            with tqdm(unit='episode', desc=f'generate {kind}') as bar:

                def progress(done: int, total: int) -> None:
                    bar.total = total
                    bar.update(done - bar.n)

                generate(plan, path, processes=2, resume=True, progress=progress)
        return TrajectoryDataset.load(path)

    def _tasks(self, dataset: TrajectoryDataset, count: int) -> np.ndarray:
        rng = np.random.default_rng(self.seed)
        return dataset.observations[rng.integers(dataset.num_rows, size=(count, 2))]

    def _critic_free(self, name: str, dataset: TrajectoryDataset) -> dict[str, Any]:
        trajectory_filter, build_s = timed(TrajectoryFilter, dataset)
        tasks = self._tasks(dataset, self.queries)
        trajectory_filter.query(*tasks[0])  # pages in what the first query alone would pay for
        found = [timed(trajectory_filter.query, *task) for task in tasks]
        # The scan is slow and varies little: a tenth of the queries is enough.
        scanned = [timed(scan, dataset, *task) for task in tasks[::10]]
        for (support, _), (rows, _) in zip(found[::10], scanned, strict=True):
            if not np.array_equal(support.indices, rows):
                raise AssertionError(f'{name}: index and scan select different rows')
        index_ms = [1e3 * seconds for _, seconds in found]
        scan_ms = float(np.median([1e3 * seconds for _, seconds in scanned]))
        return {
            'dataset': name,
            'transitions': dataset.num_rows,
            'scan': scan_ms,
            'index': float(np.median(index_ms)),
            'index p95': float(np.percentile(index_ms, 95)),
            'times faster': scan_ms / float(np.median(index_ms)),
            'build s': build_s,
            'bytes per row': trajectory_filter.index_bytes / dataset.num_rows,
        }

    def _critic_based(self, name: str, dataset: TrajectoryDataset) -> dict[str, Any]:
        """First query of a goal, the same again, and other places after a prefetch."""
        from metagcttt_core.agents.gciql import GCIQL
        import torch

        agent = GCIQL(
            dataset.obs_dim,
            dataset.act_dim,
            GCIQLSettings(hidden=self.hidden),
            torch.Generator().manual_seed(self.seed),
        )
        value_fn = agent.value_fn
        trajectory_filter = TrajectoryFilter(dataset)
        _, everywhere_s = timed(in_batches, value_fn, dataset, dataset.observations[0])
        cold, again, warm = [], [], []
        places = self._tasks(dataset, 20)[:, 0]
        for state, goal in self._tasks(dataset, self.goals):
            cold.append(timed(trajectory_filter.query, state, goal, value_fn)[1])
            again.append(timed(trajectory_filter.query, state, goal, value_fn)[1])
            trajectory_filter.prefetch_values(value_fn, goal)
            warm += [timed(trajectory_filter.query, place, goal, value_fn)[1] for place in places]
        return {
            'dataset': name,
            'V everywhere': 1e3 * everywhere_s,
            'first query': 1e3 * float(np.median(cold)),
            'times faster': everywhere_s / float(np.median(cold)),
            'same place again': 1e3 * float(np.median(again)),
            'other places, prefetched': 1e3 * float(np.median(warm)),
            'their maximum': 1e3 * max(warm),
        }


def timed(call: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """The result of `call` for `arguments`, and the seconds it took."""
    began = time.perf_counter()
    result = call(*arguments)
    return result, time.perf_counter() - began


def in_batches(
    value_fn: Callable[[np.ndarray, np.ndarray], np.ndarray],
    dataset: TrajectoryDataset,
    goal: np.ndarray,
    batch_rows: int = 8192,
) -> np.ndarray:
    """V of every row of the dataset, (N,)."""
    rows = range(0, dataset.num_rows, batch_rows)
    return np.concatenate(
        [value_fn(dataset.observations[row : row + batch_rows], goal) for row in rows]
    )


def enlarged(dataset: TrajectoryDataset, factor: float, seed: int) -> TrajectoryDataset:
    """A dataset `factor` times as large: its first trajectories, or jittered copies of all."""
    length = dataset.num_rows // dataset.num_episodes
    if factor <= 1:
        rows = slice(0, round(factor * dataset.num_episodes) * length)
        return TrajectoryDataset.from_arrays(
            dataset.observations[rows], dataset.actions[rows], dataset.terminals[rows]
        )
    rng = np.random.default_rng(seed)
    copies = round(factor)
    observations = np.tile(dataset.observations, (copies, 1))
    observations += rng.normal(0, _JITTER_M, observations.shape).astype(np.float32)
    return TrajectoryDataset.from_arrays(
        observations, np.tile(dataset.actions, (copies, 1)), np.tile(dataset.terminals, copies)
    )


def cost_picture(sizes: list[dict[str, Any]]) -> Figure:
    """Milliseconds per query against dataset size, scan and index."""
    from matplotlib.figure import Figure

    from metagcttt_tools.common.plots import COLORS

    figure = Figure(figsize=(5, 3.5), layout='constrained')
    axes = figure.subplots()
    transitions = [row['transitions'] for row in sizes]
    for color, method in zip(COLORS, ('scan', 'index'), strict=False):
        axes.loglog(
            transitions, [row[method] for row in sizes], marker='o', color=color, label=method
        )
    axes.set_xlabel('transitions in the dataset')
    axes.set_ylabel('milliseconds per query (median)')
    axes.grid(which='both', alpha=0.3)
    axes.legend()
    return figure
