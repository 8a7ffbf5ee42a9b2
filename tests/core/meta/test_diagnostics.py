"""Means over outer steps, by hand."""

from metagcttt_core import SupportSet
from metagcttt_core.adaptation.inner_loop import InnerLoopResult
from metagcttt_core.meta import OuterStep
from metagcttt_core.meta.diagnostics import OuterStepScalars
from metagcttt_core.meta.tasks import MetaTask
import numpy as np
import pytest
from tests.core.builders import tiny_agent
import torch


def split(size: int, milliseconds: float = 0.0) -> SupportSet:
    return SupportSet(np.arange(size), [], np.zeros(0), np.zeros(0), 1, 1, milliseconds)


def test_means_by_hand():
    agent = tiny_agent()
    scalars = OuterStepScalars(agent)
    for step, (best, test_losses) in enumerate([(0, [1.0, 2.0, 4.0]), (2, [3.0, 2.5, 2.0])]):
        train = split(8, milliseconds=2.0 + step)
        task = MetaTask(np.zeros(2), train, split(2), num_transitions=40, redraws=step)
        result = InnerLoopResult(agent, [5.0 + step, 1.0 + step], test_losses, best)
        scalars.add(OuterStep(step + 1, [task], [result]))
    with torch.no_grad():
        agent.actor.mean.bias.add_(torch.tensor([3.0, 4.0]))
    means = scalars.means(agent)
    assert means['inner/best_step'] == 1
    assert means['inner/rejected'] == 0.5
    assert (means['inner/first_train_loss'], means['inner/last_train_loss']) == (5.5, 1.5)
    assert (means['inner/first_test_loss'], means['inner/last_test_loss']) == (2.0, 3.0)
    assert means['inner/best_test_loss'] == 1.5
    assert (means['task/support_transitions'], means['task/redraws']) == (40, 0.5)
    assert means['task/filter_ms'] == 2.5
    assert means['meta/drift'] == pytest.approx(5.0, rel=1e-5)


def test_each_mean_covers_the_steps_since_the_last():
    agent = tiny_agent()
    scalars = OuterStepScalars(agent)
    task = MetaTask(np.zeros(2), split(1), split(1), num_transitions=2, redraws=0)
    for best in (4, 6):
        scalars.add(OuterStep(1, [task], [InnerLoopResult(agent, [0.0], [], best)]))
        means = scalars.means(agent)
        assert means['inner/best_step'] == best
        assert means['inner/first_test_loss'] is None
        assert means['meta/drift'] == 0
    assert scalars.means(agent)['inner/best_step'] is None
