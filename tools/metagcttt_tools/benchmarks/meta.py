"""Speed of meta-post-training: an outer step by parts, beside a plain PyTorch loop."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
import time
from typing import Any, Self, TYPE_CHECKING

from metagcttt_core import MetaConfig, TrajectoryDataset, TrajectoryFilter
from metagcttt_core.retrieval import FilterSettings
import numpy as np
from pydantic import Field, model_validator
from tqdm import tqdm

from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report

if TYPE_CHECKING:
    import torch
    from torch import nn

_DESCRIPTION = """Speed of meta-post-training: an outer step by parts, beside a plain PyTorch loop.

Example: metagcttt benchmark meta
Prints a table and writes JSON."""


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    parse(MetaBenchmark, _DESCRIPTION, 'benchmark meta', argv).run()


class MetaBenchmark(Benchmark):
    """Outer steps per second of GCBC, by parts, and of meta-batches adapted together."""

    dataset: Path = Field(
        Path('assets/pointmaze-medium-navigate/dataset.npz'), description='dataset (npz)'
    )
    out: Path = Field(Path('out/benchmark/meta.json'), description='file for the results')
    hidden: tuple[int, ...] = Field((256, 256, 256), description='units of the hidden layers')
    meta: MetaConfig = MetaConfig(
        algorithm='reptile',
        outer_steps=4,
        inner_steps=50,
        inner_lr=1e-4,
        batch_size=256,
        filter=FilterSettings(variant='gcttt'),
    )
    rounds: int = Field(8, ge=1, description='of outer_steps outer steps and as many plain ones')
    threads: int = Field(1, ge=1, description='threads for tensor operations')
    tasks: tuple[int, ...] = Field((2, 4, 8), description='sizes of the meta-batches')
    seed: int = Field(0, ge=0, description='of tasks and batches')

    @model_validator(mode='after')
    def _measurable(self) -> Self:
        default = FilterSettings().min_steps
        if self.meta.actor_only or self.meta.filter.min_steps != default:
            raise ValueError(
                'meta.actor_only and meta.filter.min_steps have no effect on GCBC, which has no '
                'critic'
            )
        if self.meta.outer_steps < 2:
            raise ValueError(
                f'meta.outer_steps is {self.meta.outer_steps}, but the first outer step is not '
                'measured, since it builds the index of the filter: set at least 2'
            )
        return self

    def run(self) -> None:
        """Measure, print and write."""
        import torch

        torch.set_num_threads(self.threads)
        dataset = TrajectoryDataset.load(self.dataset)
        outer, parts = self._outer_steps(dataset)
        batches = self._meta_batches(dataset)
        write_report(
            self.out, self, {'outer_step': outer, 'parts': parts, 'meta_batches': batches}
        )
        print('An outer step (medians):\n' + markdown_table([outer]))
        print('By parts, under the profiler:\n' + markdown_table(parts))
        print('Inner loops of a meta-batch (medians):\n' + markdown_table(batches))
        print(f'results: {self.out}')

    def _outer_steps(self, dataset: TrajectoryDataset) -> tuple[dict[str, Any], list[Any]]:
        """Time of an outer step beside that of a plain PyTorch loop; and its parts."""
        from metagcttt_core import make_agent, post_train

        agent = make_agent(
            'gcbc',
            obs_dim=dataset.obs_dim,
            act_dim=dataset.act_dim,
            hidden=self.hidden,
            seed=self.seed,
        )
        ours: list[float] = []
        plain: list[float] = []
        plain_step = plain_outer_step(dataset, self.hidden, self.meta)
        for round_ in tqdm(range(self.rounds), unit='round', desc='outer steps'):
            ends: list[float] = []
            post_train(
                agent,
                dataset,
                self.meta,
                self.seed + round_,
                on_step=lambda *_, ends=ends: ends.append(time.perf_counter()),
            )
            ours += np.diff(ends).tolist()  # without the first, which builds the filter's index
            plain += [seconds(plain_step) for _ in ends]
        parts = parts_of(partial(post_train, agent, dataset, self.meta, self.seed))
        step_s, plain_s = float(np.median(ours)), float(np.median(plain))
        outer = {
            'outer steps per second': 1 / step_s,
            'ms': 1e3 * step_s,
            'plain PyTorch loop ms': 1e3 * plain_s,
            'times faster': plain_s / step_s,
        }
        return outer, parts

    def _meta_batches(self, dataset: TrajectoryDataset) -> list[dict[str, Any]]:
        """Inner loops one by one and together, for networks of several sizes."""
        from metagcttt_core import make_agent
        from metagcttt_core.meta.experts import adapt_to_tasks, make_inner_loops
        from metagcttt_core.meta.tasks import TaskSampler

        rows = []
        sizes = [((32, 32), 64), ((64, 64), 256), ((256, 256, 256), 32), (self.hidden, 256)]
        for hidden, batch_size in tqdm(sizes, unit='size', desc='meta-batches'):
            agent = make_agent(
                'gcbc',
                obs_dim=dataset.obs_dim,
                act_dim=dataset.act_dim,
                hidden=hidden,
                seed=self.seed,
            )
            sampler = TaskSampler(TrajectoryFilter(dataset, self.meta.filter), 0.2, 128)
            for count in self.tasks:
                config = self.meta.model_copy(
                    update={'batch_size': batch_size, 'meta_batch_size': count}
                )
                rngs = [np.random.default_rng((self.seed, number)) for number in range(count)]
                tasks = [sampler.sample(rng) for rng in rngs]
                times: dict[bool, list[float]] = {False: [], True: []}
                for _ in range(self.rounds):
                    for together, taken in times.items():
                        loops = make_inner_loops(agent, config, together=together)
                        arguments = (agent, dataset, tasks, config, rngs, loops)
                        taken.append(seconds(partial(adapt_to_tasks, *arguments)))
                alone_s, together_s = (float(np.median(taken)) for taken in times.values())
                rows.append(
                    {
                        'hidden': ' x '.join(map(str, hidden)),
                        'batch': batch_size,
                        'tasks': count,
                        'one by one ms': 1e3 * alone_s,
                        'together ms': 1e3 * together_s,
                        'times faster': alone_s / together_s,
                    }
                )
        return rows


def seconds(call: Callable[[], Any]) -> float:
    """Time that a call takes."""
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def plain_outer_step(
    dataset: TrajectoryDataset, hidden: tuple[int, ...], config: MetaConfig
) -> Callable[[], None]:
    """The tensor operations of an outer step of GCBC and nothing else, on batches made before."""
    import torch
    from torch import nn

    widths = (2 * dataset.obs_dim, *hidden)
    layers: list[nn.Module] = []
    for inputs, outputs in zip(widths, hidden, strict=False):
        layers += [nn.Linear(inputs, outputs), nn.GELU(approximate='tanh')]
    network = nn.Sequential(*layers, nn.Linear(hidden[-1], dataset.act_dim))
    optimizer = torch.optim.Adam(network.parameters(), lr=config.inner_lr, fused=True)

    def batch(size: int) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.randn(size, widths[0]), torch.randn(size, dataset.act_dim)

    batches = [batch(config.batch_size) for _ in range(config.inner_steps)]
    test_batch = batch(config.max_test)

    def loss_of(inputs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return 0.5 * (actions - network(inputs)).square().sum(-1).mean()

    def outer_step() -> None:
        with torch.no_grad():
            loss_of(*test_batch)
        for inputs, actions in batches:
            optimizer.zero_grad()
            loss_of(inputs, actions).backward()
            optimizer.step()
            with torch.no_grad():
                loss_of(*test_batch)

    return outer_step


def parts_of(post_train: Callable[..., Any]) -> list[dict[str, Any]]:
    """Milliseconds of each part of an outer step, as `torch.profiler` sees it.

    Args:
        post_train: Runs some outer steps; takes `on_step`.
    """
    from metagcttt_core.adaptation.batches import BATCHES
    from metagcttt_core.adaptation.inner_loop import INNER_STEP, TEST_LOSS
    from metagcttt_core.meta import OuterStep
    from metagcttt_core.meta.post_train import INDEX, TASKS, UPDATE
    from torch.profiler import profile, ProfilerActivity

    steps: list[OuterStep] = []
    ends: list[float] = []

    def on_step(step: OuterStep, _: Any) -> None:
        steps.append(step)
        ends.append(time.perf_counter())

    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        began = time.perf_counter()
        post_train(on_step=on_step)
    ranges = {event.key: event.cpu_time_total / 1e3 for event in profiler.key_averages()}
    filter_ms = sum(task.filter_ms for step in steps for task in step.tasks)
    parts = {
        'filter': filter_ms,
        'task': ranges[TASKS] - filter_ms,
        'batches': ranges[BATCHES],
        'inner steps': ranges[INNER_STEP],
        'test losses': ranges.get(TEST_LOSS, 0.0),
        'update': ranges[UPDATE],
    }
    total = 1e3 * (ends[-1] - began) - ranges[INDEX]  # which belongs to no step
    parts['rest'] = total - sum(parts.values())
    return [
        {'part': name, 'ms': part / len(steps), 'share': f'{part / total:.1%}'}
        for name, part in parts.items()
    ]
