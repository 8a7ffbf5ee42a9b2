"""Train the controller that walks the ant along a direction, which offline data needs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field
from sim_bridge.controllers import LearnedFollower
from sim_bridge.controllers.training_ground import TrainingGround
from tqdm import tqdm

from metagcttt_tools.common.cli import fail, parse
from metagcttt_tools.common.resume import nested, Resumable
from metagcttt_tools.common.run_log import RunLog
from metagcttt_tools.common.session import (
    files_of_run,
    provenance,
    sole_writer,
    time_limit,
    use_threads,
    write_settings,
)
from metagcttt_tools.common.stopping import stop_on_signal
from metagcttt_tools.controller.config import SACConfig

if TYPE_CHECKING:
    from torch import Tensor

_DESCRIPTION = """Train the controller that walks the ant along a direction (SAC).

Example: metagcttt controller train --out out/ant-controller
Writes OUT/controller, OUT/checkpoint.safetensors (replay buffer included) and logs.
Ctrl-C saves and ends; --resume, with no other flag than --out, continues with a new episode."""


class TrainControllerSettings(Resumable):
    """Settings of the program."""

    may_change = frozenset({'checkpoint_every', 'log_every', 'decay_steps', 'time_limit'})
    may_grow = frozenset({'steps'})

    out: Path = Field(Path('out/ant-controller'), description='folder of the run')
    steps: int = Field(200_000, ge=1, description='environment steps')
    decay_steps: int = Field(
        25_000, ge=0, description='last steps, over which the learning rate falls linearly to zero'
    )
    update_every: int = Field(2, ge=1, description='environment steps per update')
    replay_size: int = Field(1_000_000, ge=1, description='latest transitions to learn from')
    random_steps: int = Field(5000, ge=1, description='uniformly random actions at the start')
    sac: SACConfig = SACConfig()
    seed: int = Field(0, ge=0, description='random seed')
    checkpoint_every: int = Field(20_000, ge=1, description='steps between checkpoints')
    log_every: int = Field(2000, ge=1, description='steps between log lines')
    threads: int = Field(1, ge=1, description='threads for tensor operations')
    time_limit: float | None = time_limit()

    @property
    def checkpoint(self) -> Path:
        """State of the training for a resumed run."""
        return self.out / 'checkpoint.safetensors'


class ControllerTraining:
    """One run: its robot, learner and replay buffer."""

    def __init__(self, settings: TrainControllerSettings) -> None:
        """Build everything, fresh."""
        from metagcttt_tools.controller.replay import ReplayBuffer
        from metagcttt_tools.controller.sac import SAC

        self.settings = settings
        self.ground = TrainingGround()
        dims = self.ground.obs_dim, self.ground.act_dim
        self.learner = SAC(*dims, settings.sac, settings.seed)
        self.replay = ReplayBuffer(settings.replay_size, *dims)

    def run(
        self,
        log: Callable[[int, dict[str, float]], None],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Train to the last step; returns whether it got there.

        Args:
            log: Told the number of steps done and scalars, every `log_every` steps.
            should_stop: Asked after every step; true saves and ends the run.
        """
        settings, replay = self.settings, self.replay
        meters = _Meters()
        observation = None
        for step in range(replay.added, settings.steps):
            rng = np.random.default_rng((settings.seed, step))
            if observation is None:
                observation = self.ground.reset(seed=int(rng.integers(2**32)))
            action = self._action(observation, step, rng)
            result = self.ground.step(action)
            replay.add(
                observations=observation,
                actions=action,
                next_observations=result.observation,
                rewards=result.reward,
                masks=not result.fallen,
            )
            meters.add(result.reward, result.fallen)
            observation = None if result.over else result.observation
            done = step + 1
            if done > settings.random_steps and done % settings.update_every == 0:
                batch = replay.sample(settings.sac.batch_size, rng)
                self.learner.scale_lr(self._lr_share(step))
                number = done // settings.update_every
                actor = number % settings.sac.actor_every == 0
                meters.losses |= self.learner.update(batch, rng, actor=actor)
            if done % settings.log_every == 0:
                log(done, meters.read())
            stopping = should_stop()
            if stopping or done % settings.checkpoint_every == 0 or done == settings.steps:
                self.save()
            if stopping and done < settings.steps:
                return False
        return True

    def follower(self) -> LearnedFollower:
        """The deterministic controller learned so far: the mean of the actor."""
        actor = self.learner.actor
        weights = [weight.detach()[0].numpy().copy() for weight in actor.weights]
        biases = [bias.detach()[0, 0].numpy().copy() for bias in actor.biases]
        act_dim = self.ground.act_dim
        weights[-1] = weights[-1][:, :act_dim].copy()  # the rest is the standard deviation
        biases[-1] = biases[-1][:act_dim].copy()
        metadata = {
            'steps': self.replay.added,
            'decay_steps': self.settings.decay_steps,
            'training': nested(self.settings.decisive()),
            **provenance(),
        }
        return LearnedFollower('ant', tuple(weights), tuple(biases), metadata)

    def save(self) -> None:
        """Write the controller, then the checkpoint, each whole or not at all."""
        from metagcttt_tools.controller.training_state import write_training_state

        self.follower().save(self.settings.out / 'controller')
        tensors = {**self.learner.tensors(), **self.replay.tensors()}
        write_training_state(self.settings.checkpoint, self.settings.decisive(), tensors)

    def restore(self) -> None:
        """Go on from the checkpoint in OUT.

        Raises:
            ValueError: If it is damaged or of a run with other settings; names the first that
                differs.
        """
        from metagcttt_tools.controller.training_state import read_training_state

        path = self.settings.checkpoint
        tensors = read_training_state(path, self.settings.decisive())
        done = int(tensors['replay.added'])
        if done > self.settings.steps:
            raise ValueError(f'{path}: has {done} steps already, asked for {self.settings.steps}')
        self.learner.load_tensors(tensors)
        self.replay.load_tensors(tensors)

    def _lr_share(self, step: int) -> float:
        left = self.settings.steps - step
        return min(1.0, left / self.settings.decay_steps) if self.settings.decay_steps else 1.0

    def _action(self, observation: np.ndarray, step: int, rng: np.random.Generator) -> np.ndarray:
        if step < self.settings.random_steps:
            return rng.uniform(-1.0, 1.0, self.ground.act_dim)
        return self.learner.act(observation, rng)


class _Meters:
    """Running figures since the last log line."""

    def __init__(self) -> None:
        self._rewards: list[float] = []
        self._falls = 0
        self.losses: dict[str, Tensor] = {}

    def add(self, reward: float, fallen: bool) -> None:
        self._rewards.append(reward)
        self._falls += fallen

    def read(self) -> dict[str, float]:
        """Scalars of the stretch, which ends here."""
        scalars = {'reward_per_step': float(np.mean(self._rewards)), 'falls': float(self._falls)}
        scalars |= {name: float(value) for name, value in self.losses.items()}
        self._rewards, self._falls = [], 0
        return scalars


def main(argv: list[str] | None = None) -> None:
    """Run the program."""
    settings = parse(TrainControllerSettings, _DESCRIPTION, 'controller train', argv)
    use_threads(settings.threads)
    try:
        with sole_writer(settings.out, *files_of_run(settings.out)):
            _run(settings)
    except ValueError as error:
        fail(str(error))


def _run(settings: TrainControllerSettings) -> None:
    training = ControllerTraining(settings)
    if settings.checkpoint.exists():
        if not settings.resume:
            fail(f'{settings.checkpoint} exists: pass --resume or choose another --out')
        training.restore()
    write_settings(settings.out, settings)
    first = training.replay.added
    with (
        stop_on_signal(settings.time_limit) as stop,
        RunLog(settings.out, first) as run_log,
        tqdm(total=settings.steps, initial=first, unit='step', desc='ant') as bar,
    ):

        def log(step: int, scalars: dict[str, float]) -> None:
            run_log.write(step, scalars)
            bar.set_postfix(reward=f'{scalars["reward_per_step"]:.3f}', refresh=False)
            bar.update(step - bar.n)

        finished = training.run(log, stop.is_set)
    if not finished:
        print(f'stopped after step {training.replay.added}; pass --resume to continue')
        raise SystemExit(stop.status)
    print(f'controller: {settings.out / "controller"}')
