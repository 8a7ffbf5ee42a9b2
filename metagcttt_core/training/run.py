"""Long runs: periodic checkpoints, a clean stop, and going on where they ended."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python
import torch

from metagcttt_core.agents.agent import Agent
from metagcttt_core.training.checkpoint import (
    CheckpointError,
    has_checkpoint,
    load_checkpoint,
    load_training_state,
    save_checkpoint,
    TrainingState,
)
from metagcttt_core.training.optimizers import misfit


class TrainingInterrupted(Exception):
    """A run was asked to stop; its checkpoint holds everything done so far."""


class TrainingRun:
    """Checkpoints of one run in one folder.

    All randomness of a step derives from the run's seed and the step's number, so weights,
    optimiser and step number are all there is to save, and a resumed run ends with the same bits.
    """

    def __init__(
        self,
        stage: str,
        settings: dict[str, Any],
        folder: Path | None = None,
        *,
        every: int = 1000,
        resume: bool = False,
        should_stop: Callable[[], bool] = lambda: False,
        writes: bool = True,
    ) -> None:
        """Describe the run.

        Args:
            stage: `pretrain` or `post_train`.
            settings: Everything that decides the result; resuming with other settings is refused.
            folder: Where checkpoints go; none are written by default.
            every: Steps between checkpoints.
            resume: Go on from the checkpoint in `folder`, if there is one.
            should_stop: Asked after every step; true saves a checkpoint and ends the run.
            writes: Whether this process saves; of several that do the same, one should.
        """
        self._stage = stage
        self._settings = to_jsonable_python(settings)  # as they come back from a checkpoint
        self._folder = folder
        self._every = every
        self._resume = resume
        self._should_stop = should_stop
        self._writes = writes

    def restore(self, agent: Agent, optimizer: torch.optim.Optimizer | None) -> int:
        """Load the checkpoint to go on from into `agent` and `optimizer`; returns the steps done.

        Raises:
            CheckpointError: If the checkpoint belongs to another stage or other settings, by name,
                or its optimiser state does not fit.
        """
        if not self._resume or self._folder is None or not has_checkpoint(self._folder):
            return 0
        state = load_training_state(self._folder)
        if state.stage != self._stage:
            raise CheckpointError(f'{self._folder}: is a {state.stage} run, not {self._stage}')
        for name in sorted(state.settings.keys() | self._settings.keys()):
            saved, asked = state.settings.get(name), self._settings.get(name)
            if saved != asked:
                raise CheckpointError(
                    f'{self._folder}: cannot resume, {name} was {saved!r} and is now {asked!r}'
                )
        saved_agent = load_checkpoint(self._folder)
        for name in ('obs_dim', 'act_dim', 'settings'):
            saved, asked = getattr(saved_agent, name), getattr(agent, name)
            if saved != asked:
                raise CheckpointError(
                    f'{self._folder}: cannot resume, {name} of the agent was {saved}, is {asked}'
                )
        agent.load_state_dict(saved_agent.state_dict())
        if isinstance(optimizer, torch.optim.Adam):
            (group,) = optimizer.param_groups
            if fault := misfit(state.optimizer, group['params']):
                raise CheckpointError(f'{self._folder}: cannot resume, {fault}')
        if optimizer is not None:
            optimizer.load_state_dict({**optimizer.state_dict(), 'state': state.optimizer})
        return state.step

    def step_done(
        self, agent: Agent, optimizer: torch.optim.Optimizer | None, step: int, last: int
    ) -> None:
        """Save when due.

        Args:
            agent: The agent as it is after `step` steps.
            optimizer: Its optimiser, if it has one.
            step: Steps done.
            last: Number of steps of the whole run.

        Raises:
            TrainingInterrupted: After saving, when the run was asked to stop.
        """
        stopping = step < last and self._should_stop()
        due = stopping or step == last or step % self._every == 0
        if due and self._writes and self._folder is not None:
            state = optimizer.state_dict()['state'] if optimizer is not None else {}
            training = TrainingState(self._stage, step, self._settings, state)
            save_checkpoint(agent, self._folder, training)
        if stopping:
            raise TrainingInterrupted(f'stopped after step {step} of {last}')
