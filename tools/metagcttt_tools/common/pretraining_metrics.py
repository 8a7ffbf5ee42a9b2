"""Metrics of a pre-training run: training and validation losses, success, speed."""

from pathlib import Path
import time

from metagcttt_core import (
    Agent,
    DatasetError,
    evaluate_success,
    TrajectoryDataset,
)
from metagcttt_core.training.config import Precision
from metagcttt_core.training.numerics import loss_function
import numpy as np
from sim_bridge import make_simulator
from torch import no_grad, Tensor


class Validation:
    """Losses on held-out data, with goals drawn from that data."""

    def __init__(
        self, dataset: TrajectoryDataset | None, batch_size: int, precision: Precision
    ) -> None:
        """Draw batches of `batch_size` from `dataset`; without one there are no losses."""
        self._dataset = dataset
        self._batch_size = batch_size
        self._precision: Precision = precision

    def losses(self, agent: Agent, seed: int, step: int) -> dict[str, float]:
        """The agent's losses on one batch, which the seed and the step decide."""
        if self._dataset is None:
            return {}
        rng = np.random.default_rng((seed, step, 1))
        batch = agent.relabeller(self._dataset).sample(self._batch_size, rng)
        with no_grad():
            loss, parts = loss_function(agent, precision=self._precision)(agent.tensors(batch))
        return {'val/loss': float(loss)} | {f'val/{k}': float(part) for k, part in parts.items()}


def validation_data(training_data: Path, like: TrajectoryDataset) -> TrajectoryDataset | None:
    """The dataset NAME-val.npz beside NAME.npz, if there is one.

    Raises:
        DatasetError: If its observations or actions are of another width than the dataset's.
    """
    path = training_data.with_name(f'{training_data.stem}-val.npz')
    if not path.exists():
        return None
    dataset = TrajectoryDataset.load(path)
    for name in ('obs_dim', 'act_dim'):
        got, expected = getattr(dataset, name), getattr(like, name)
        if got != expected:
            raise DatasetError(f'{path}: {name} is {got}, that of {training_data} is {expected}')
    return dataset


class Throughput:
    """Updates per second since the last time asked, time in other work left out."""

    def __init__(self) -> None:
        """Start the clock."""
        self._began = time.perf_counter()
        self._updates = 0

    def count(self) -> None:
        """Count an update."""
        self._updates += 1

    def rate(self) -> float:
        """Updates per second; none counted yet give 0."""
        return self._updates / (time.perf_counter() - self._began)

    def restart(self) -> None:
        """Forget what was counted."""
        self._began = time.perf_counter()
        self._updates = 0


def success_rates(agent: Agent, environment: str, episodes: int, seed: int) -> dict[str, float]:
    """Success of the policy as it is, by task and on average, without test-time training."""
    simulator = make_simulator(environment)
    results = evaluate_success(agent, simulator, episodes=episodes, seed=seed)
    simulator.close()
    rates = {f'evaluation/task{task}': rate for task, rate in results['tasks'].items()}
    return {'evaluation/success': results['mean'], **rates}


def as_scalars(losses: dict[str, Tensor]) -> dict[str, float]:
    """Losses of a step by the names that logs use."""
    return {f'train/{name}': float(value) for name, value in losses.items()}
