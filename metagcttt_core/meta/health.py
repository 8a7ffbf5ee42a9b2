"""Health of a post-training run: divergence, rejected inner loops, damage."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
import math
from statistics import fmean, pstdev
from typing import Any

import torch

from metagcttt_core.agents.agent import Agent
from metagcttt_core.meta.report import OuterStep

_WINDOW = 20  # records
_REJECTED = 0.95
_DEVIATIONS = 3.0


class DivergedError(RuntimeError):
    """A loss or a weight became non-finite; the run cannot continue.

    Attributes:
        step: The outer step in which it happened, from 1.
    """

    def __init__(self, step: int, what: str) -> None:
        """Name the non-finite value."""
        super().__init__(
            f'outer step {step}: {what} is not finite; a smaller inner_lr or meta_lr usually helps'
        )
        self.step = step


def check_finite(outer: OuterStep, agent: Agent) -> None:
    """Refuse to continue from non-finite numbers.

    Raises:
        DivergedError: If a loss of the outer step or a weight after it is not finite; names which.
    """
    for what in _not_finite(outer, agent):
        raise DivergedError(outer.step, what)


def _not_finite(outer: OuterStep, agent: Agent) -> Iterator[str]:
    for number, task in enumerate(outer.tasks):
        for kind, losses in (('train', task.train_losses), ('test', task.test_losses)):
            for step, loss in enumerate(losses):
                if not math.isfinite(loss):
                    yield f'the {kind} loss of task {number} after {step} inner steps ({loss})'
    for name, weight in agent.state_dict().items():
        if not torch.isfinite(weight).all():
            yield f'weight {name}'


class HealthWatch:
    """Watches the records of a run for rejected inner loops and a damaged initialisation."""

    def __init__(self, records: Iterable[Mapping[str, Any]] = ()) -> None:
        """Start from the records so far, means by the names of `diagnostics.Record`."""
        self._rejected: deque[float] = deque(maxlen=_WINDOW)
        self._first_losses: list[float] = []
        self._last_losses: deque[float] = deque(maxlen=_WINDOW)
        self._initial_losses: deque[float] = deque(maxlen=_WINDOW)
        self._expert_losses: deque[float] = deque(maxlen=_WINDOW)
        self._warned: set[str] = set()
        for record in records:
            self.add(record)

    def add(self, means: Mapping[str, Any]) -> list[str]:
        """Add a record; returns warnings about what it shows."""
        self._rejected.append(means.get('inner/rejected') or 0.0)
        # Without early stopping there is no test loss; the first train batch tells the same.
        losses = (means.get(f'inner/first_{kind}_loss') for kind in ('test', 'train'))
        loss = next((loss for loss in losses if loss is not None), None)
        if loss is not None and len(self._first_losses) < _WINDOW:
            self._first_losses.append(loss)
        elif loss is not None:
            self._last_losses.append(loss)
        if 'inner/expert_loss' in means:
            self._initial_losses.append(means['inner/initial_loss'])
            self._expert_losses.append(means['inner/expert_loss'])
        found = {
            'rejected': self._rejections(),
            'damaged': self._damage(),
            'worse': self._worse_than_at_first(),
        }
        new = [text for sign, text in found.items() if text and sign not in self._warned]
        self._warned = {sign for sign, text in found.items() if text}
        return new

    def _rejections(self) -> str:
        share = fmean(self._rejected)
        if len(self._rejected) < _WINDOW or share < _REJECTED:
            return ''
        return (
            f'{share:.0%} of the inner loops are rejected: no step lowers the test loss, so the '
            'policy hardly changes; a smaller inner_lr usually helps'
        )

    def _damage(self) -> str:
        if len(self._last_losses) < _WINDOW:
            return ''
        before, now = fmean(self._first_losses), fmean(self._last_losses)
        if now <= before + _DEVIATIONS * pstdev(self._first_losses):
            return ''
        return (
            f'the loss before adapting rose from {before:.4g} to {now:.4g}: the initialisation is '
            'being damaged; a smaller inner_lr or meta_lr usually helps'
        )

    def _worse_than_at_first(self) -> str:
        if len(self._expert_losses) < _WINDOW:
            return ''
        rises = [b - a for a, b in zip(self._initial_losses, self._expert_losses, strict=True)]
        if fmean(rises) <= _DEVIATIONS * pstdev(rises) / math.sqrt(_WINDOW):
            return ''
        initial, expert = fmean(self._initial_losses), fmean(self._expert_losses)
        return (
            f'the test loss after adapting, {expert:.4g}, is above the {initial:.4g} that the '
            'pre-trained policy has on the same tasks without adapting: post-training does harm; '
            'a smaller inner_lr or meta_lr usually helps'
        )
