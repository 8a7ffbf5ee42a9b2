"""Cost of a training step: the whole update against the bare matrix products inside it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import time
from typing import Any, NamedTuple, TYPE_CHECKING

from metagcttt_core.agents import AgentName
from metagcttt_core.training.config import Precision
import numpy as np
from pydantic import Field
from tqdm import tqdm

from metagcttt_tools.common.cli import parse
from metagcttt_tools.common.results import Benchmark, markdown_table, write_report

if TYPE_CHECKING:
    from metagcttt_core import Agent
    from metagcttt_core.agents import TensorBatch
    from torch import Tensor

    Product = tuple[Tensor, Tensor]


class Size(NamedTuple):
    """Units of each of the hidden layers, how many there are, and transitions in a batch."""

    units: int
    layers: int
    batch: int


class Learner(NamedTuple):
    """An agent and the settings that decide the cost of its step."""

    agent: AgentName
    settings: dict[str, Any]

    def __str__(self) -> str:
        """The agent's name and its settings' values."""
        return ' '.join([self.agent, *map(str, self.settings.values())])


LEARNERS = (
    Learner('gcbc', {}),
    *(Learner('gciql', {'actor_loss': loss}) for loss in ('bc', 'awr', 'ddpgbc')),
    Learner('saw', {}),
)


_DESCRIPTION = """Cost of a training step: the whole update against its matrix products.

Example: metagcttt benchmark training
Prints a table and writes JSON."""


def main(argv: list[str] | None = None) -> None:
    """Run the benchmark."""
    parse(TrainingBenchmark, _DESCRIPTION, 'benchmark training', argv).run()


class TrainingBenchmark(Benchmark):
    """Milliseconds per update of each agent beside the matrix products of the same step."""

    out: Path = Field(Path('out/benchmark/training.json'), description='file for the results')
    sizes: tuple[tuple[int, int, int], ...] = Field(
        ((512, 3, 1024), (256, 3, 256), (128, 3, 256)),
        description='units, hidden layers and batch size of each measurement',
    )
    threads: tuple[int, ...] = Field((1, 2), description='threads for tensor operations')
    obs_dim: int = Field(2, ge=1, description='width of an observation')
    act_dim: int = Field(2, ge=1, description='width of an action')
    precisions: tuple[Precision, ...] = Field(
        ('float32', 'bfloat16'), description='of the matrix products'
    )
    compiled: bool = Field(True, description='also measure compiled losses (minutes to compile)')
    repeats: int = Field(15, ge=3, description='updates per measurement, of which the median')

    def run(self) -> None:
        """Measure, print and write."""
        import torch

        rows = []
        total = len(self.threads) * len(self.sizes) * len(LEARNERS) * len(self.precisions)
        with tqdm(total=total, unit='row', desc='training') as bar:
            for threads in self.threads:
                torch.set_num_threads(threads)
                for size in self.sizes:
                    for learner in LEARNERS:
                        for precision in self.precisions:
                            rows.append(self._row(learner, Size(*size), precision))
                            bar.update()
        write_report(self.out, self, {'updates': rows})
        print('Milliseconds per update (medians):\n' + markdown_table(rows))
        print(f'results: {self.out}')

    def _row(self, learner: Learner, size: Size, precision: Precision) -> dict[str, Any]:
        from metagcttt_core import make_agent
        import torch

        hidden = (size.units,) * size.layers
        agent = make_agent(
            learner.agent,
            obs_dim=self.obs_dim,
            act_dim=self.act_dim,
            hidden=hidden,
            **learner.settings,
        )
        batch = random_batch(agent, size.batch)
        ways = {'update': update_of(agent, batch, precision, compiled=False)}
        if self.compiled:
            torch.compiler.reset()
            ways['compiled'] = update_of(agent.clone(), batch, precision, compiled=True)
        products = products_of(ways['update'])
        ways['products'] = lambda: [torch.mm(*product) for product in products]
        times = median_ms(ways, self.repeats)
        row = {
            'agent': str(learner),
            'hidden': f'{size.units} x {size.layers}',
            'batch': size.batch,
            'threads': torch.get_num_threads(),
            'precision': precision,
            'products': times['products'],
        }
        for name in (name for name in ways if name != 'products'):
            row |= {name: times[name], f'{name} / products': times[name] / times['products']}
        return row


def products_of(update: Callable[[], Any]) -> list[Product]:
    """The operands of each matrix product of an update, in order, forward and backward."""
    import torch
    from torch.utils._python_dispatch import TorchDispatchMode

    products: list[Product] = []

    class Recorder(TorchDispatchMode):
        def __torch_dispatch__(
            self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None
        ) -> Any:
            if func is torch.ops.aten.mm.default:
                products.append((args[0], args[1]))
            elif func is torch.ops.aten.addmm.default:
                products.append((args[1], args[2]))
            return func(*args, **(kwargs or {}))

    with Recorder():
        update()
    return [(first.detach(), second.detach()) for first, second in products]


def update_of(
    agent: Agent, batch: TensorBatch, precision: Precision, *, compiled: bool
) -> Callable[[], Any]:
    """One gradient step of the agent on the batch, ready to be repeated."""
    from metagcttt_core.training.numerics import loss_function
    from metagcttt_core.training.optimizers import make_optimizer
    from metagcttt_core.training.step import gradient_step

    parameters = list(agent.trained_parameters())
    optimizer = make_optimizer('adam', parameters, 3e-4)
    losses = loss_function(agent, precision=precision, compiled=compiled)
    return lambda: gradient_step(agent, optimizer, parameters, batch, losses=losses)


def random_batch(agent: Agent, size: int) -> TensorBatch:
    """A batch of normally distributed states and goals and uniform actions."""
    rng = np.random.default_rng(0)
    states = (
        *('observations', 'next_observations', 'value_goals', 'actor_goals'),
        *('subgoals', 'waypoints'),  # of SAW
    )
    batch = {key: rng.normal(size=(size, agent.obs_dim)) for key in states}
    batch['actions'] = rng.uniform(-1, 1, size=(size, agent.act_dim))
    batch |= {'rewards': -np.ones(size), 'masks': np.ones(size)}
    return agent.tensors({key: array.astype(np.float32) for key, array in batch.items()})


def median_ms(ways: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median milliseconds of each call; see `times_ms`."""
    return {name: float(np.median(taken)) for name, taken in times_ms(ways, repeats).items()}


def times_ms(
    ways: dict[str, Callable[[], Any]],
    repeats: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Milliseconds of each call; they take turns, so that a slow spell meets all."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for call in ways.values():
        for _ in range(3):
            call()
    for _ in range(repeats):
        for name, call in ways.items():
            began = clock()
            call()
            times[name].append(1e3 * (clock() - began))
    return times
