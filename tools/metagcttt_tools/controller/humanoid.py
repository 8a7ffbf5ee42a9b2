"""Training of the humanoid controller: stages of growing difficulty, many humanoids at once."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from sim_bridge.controllers.humanoid import (
    ACTION_SIGNS,
    ACTION_SOURCES,
    HumanoidFollower,
    INPUT_DIM,
    INPUT_SIGNS,
    INPUT_SOURCES,
    MOTORS,
)
import torch
from torch import Tensor

from metagcttt_tools.common.session import provenance
from metagcttt_tools.controller.recipe import (
    AVERAGE_SHARE,
    REPLAY_SIZE,
    RETURN_STEPS,
    SAC_CONFIG,
    Stage,
    STAGES,
    UPDATES_PER_SWEEP,
    WARM_UP,
)
from metagcttt_tools.controller.replay import ReplayBuffer, Returns
from metagcttt_tools.controller.sac import SAC
from metagcttt_tools.controller.training_state import read_training_state, write_training_state


class HumanoidTraining:
    """One run: its humanoids, learner and replay buffer.

    Attributes:
        sweep: Control steps of all humanoids so far.
    """

    def __init__(self, out: Path, seed: int, stages: tuple[Stage, ...] = STAGES) -> None:
        """Build the learner, fresh."""
        self.out = out
        self.seed = seed
        self.stages = stages
        self.sweep = 0
        self.total = sum(stage.sweeps for stage in stages)
        self.learner = SAC(INPUT_DIM, len(MOTORS), SAC_CONFIG, seed)
        self.average = [weight.detach().clone() for weight in self.learner.actor.parameters()]
        self._enter()

    @property
    def checkpoint(self) -> Path:
        """State of the training for a resumed run."""
        return self.out / 'checkpoint.safetensors'

    @property
    def stage(self) -> Stage:
        """The stage of the next sweep; the last one when the run is over."""
        return self.stages[self._stage_index()]

    def run(
        self,
        log: Callable[[int, dict[str, float]], None],
        should_stop: Callable[[], bool] = lambda: False,
        log_every: int = 250,
        save_every: int = 2500,
    ) -> bool:
        """Train to the last sweep; returns whether it got there.

        Args:
            log: Told the number of sweeps done and scalars.
            should_stop: Asked after every sweep; true saves and ends the run.
            log_every: Sweeps between logs.
            save_every: Sweeps between checkpoints.
        """
        meters = _Meters()
        while self.sweep < self.total:
            meters.add(*self._sweep())
            stopping = should_stop()
            if self.sweep % log_every == 0:
                log(self.sweep, meters.read())
            if stopping or self.sweep % save_every == 0 or self.sweep == self.total:
                self.save()
            if stopping and self.sweep < self.total:
                return False
        return True

    def follower(self) -> HumanoidFollower:
        """The deterministic controller learned so far: the averaged mean of the actor."""
        layers = len(self.learner.actor.weights)
        weights = [weight[0].numpy().copy() for weight in self.average[:layers]]
        biases = [bias[0, 0].numpy().copy() for bias in self.average[layers:]]
        weights[-1] = weights[-1][:, : len(MOTORS)].copy()  # the rest is the standard deviation
        biases[-1] = biases[-1][: len(MOTORS)].copy()
        metadata = {'sweeps': self.sweep, 'training': self._decisive(), **provenance()}
        return HumanoidFollower('humanoid', tuple(weights), tuple(biases), metadata, True)

    def save(self) -> None:
        """Write the controller, then the checkpoint, each whole or not at all."""
        self.follower().save(self.out / 'controller')
        ground = {f'ground.{name}': array for name, array in self._ground.arrays().items()}
        returns = {f'returns.{name}': array for name, array in self._returns.arrays.items()}
        tensors = {
            **self.learner.tensors(),
            **{f'average.{number}': weight for number, weight in enumerate(self.average)},
            **self._replay.tensors(),
            **{name: torch.from_numpy(array) for name, array in {**ground, **returns}.items()},
            'sweep': torch.tensor(self.sweep),
        }
        write_training_state(self.checkpoint, self._decisive(), tensors)

    def restore(self) -> None:
        """Go on from the checkpoint in the folder of the run, to the same end.

        Raises:
            ValueError: If it is damaged, or of a run with another seed or other stages.
        """
        tensors = read_training_state(self.checkpoint, self._decisive())
        self.learner.load_tensors(tensors)
        for number, weight in enumerate(self.average):
            weight.copy_(tensors[f'average.{number}'])
        self.sweep = int(tensors['sweep'])
        self._enter()
        self._replay.load_tensors(tensors)
        self._ground.load_arrays(_part(tensors, 'ground.'))
        for name, array in _part(tensors, 'returns.').items():
            self._returns.arrays[name][...] = array

    def _enter(self) -> None:
        """Begin the stage of the next sweep with new humanoids and nothing to learn from."""
        self._entered = self._stage_index()
        rng = np.random.default_rng((self.seed, self._entered, self.total))
        self._ground = self.stage.course.ground(rng)
        dims = INPUT_DIM, len(MOTORS)
        self._replay = ReplayBuffer(REPLAY_SIZE, *dims)
        self._returns = Returns(RETURN_STEPS, self._ground.count, *dims, SAC_CONFIG.discount)

    def _sweep(self) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Step all humanoids once and learn; returns figures and losses."""
        rng = np.random.default_rng((self.seed, self.sweep))
        ground, replay = self._ground, self._replay
        inputs = ground.inputs
        actions = self.learner.act_all(inputs, rng)
        step = ground.step(actions, rng)
        replay.extend(
            **self._returns.add(
                inputs, actions, step.rewards, step.next_inputs, step.fallen, step.cut
            )
        )
        losses: dict[str, Tensor] = {}
        if replay.size >= WARM_UP:
            self.learner.scale_lr(self._lr_share())
            for number in range(UPDATES_PER_SWEEP):
                losses |= self._update(rng, actor=number % SAC_CONFIG.actor_every == 0)
        self.sweep += 1
        if self._stage_index() != self._entered:
            self._enter()
        return {'reward_per_step': step.rewards.mean(), **step.figures}, losses

    @torch.no_grad()
    def _average(self) -> None:
        weights: list[Tensor] = list(self.learner.actor.parameters())
        torch._foreach_lerp_(self.average, weights, AVERAGE_SHARE)

    def _update(self, rng: np.random.Generator, *, actor: bool) -> dict[str, Tensor]:
        batch = mirror_some(self._replay.sample(SAC_CONFIG.batch_size, rng), rng)
        scalars = self.learner.update(batch, rng, actor=actor)
        if actor:
            self._average()
        return scalars

    def _lr_share(self) -> float:
        first, last = self.stage.lr
        done = self.sweep - sum(stage.sweeps for stage in self.stages[: self._entered])
        return first + (last - first) * done / self.stage.sweeps

    def _stage_index(self) -> int:
        end = 0
        for index, stage in enumerate(self.stages):
            end += stage.sweeps
            if self.sweep < end:
                return index
        return len(self.stages) - 1

    def _decisive(self) -> dict[str, Any]:
        stages = [repr(stage) for stage in self.stages]
        return {'seed': self.seed, 'sac': SAC_CONFIG.model_dump(mode='json'), 'stages': stages}


def mirror_some(batch: dict[str, Tensor], rng: np.random.Generator) -> dict[str, Tensor]:
    """Exchange left and right in half of the transitions, drawn at random."""
    chosen = torch.from_numpy(rng.random((len(batch['rewards']), 1)) < 0.5)
    mirrored = dict(batch)
    for name, (sources, signs) in _MIRRORS.items():
        values = batch[name]
        mirrored[name] = torch.where(chosen, values[:, sources] * signs, values)
    return mirrored


_INPUT_MIRROR = torch.from_numpy(INPUT_SOURCES), torch.from_numpy(INPUT_SIGNS)
_MIRRORS = {
    'observations': _INPUT_MIRROR,
    'next_observations': _INPUT_MIRROR,
    'actions': (torch.from_numpy(ACTION_SOURCES), torch.from_numpy(ACTION_SIGNS)),
}


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, np.ndarray]:
    return {
        name.removeprefix(prefix): tensor.numpy()
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }


class _Meters:
    """Running figures since the last log line."""

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self._figures: list[dict[str, float]] = []
        self._losses: dict[str, Tensor] = {}

    def add(self, figures: dict[str, float], losses: dict[str, Tensor]) -> None:
        self._figures.append(figures)
        self._losses = losses

    def read(self) -> dict[str, float]:
        """Scalars of the stretch, which ends here."""
        scalars = {
            name: float(np.mean([figures[name] for figures in self._figures]))
            for name in self._figures[0]
        }
        scalars |= {name: float(value) for name, value in self._losses.items()}
        self._clear()
        return scalars
