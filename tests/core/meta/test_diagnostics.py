"""Records over outer steps, by hand."""

from metagcttt_core import SupportSet
from metagcttt_core.adaptation.result import Adaptation
from metagcttt_core.meta import OuterStep, TaskReport
from metagcttt_core.meta.diagnostics import Diagnostics
from metagcttt_core.meta.tasks import MetaTask
import numpy as np
import pytest
from tests.core.builders import tiny_agent
import torch


def report(
    best_step,
    test_losses,
    *,
    train_losses=(0.0,),
    num_transitions=2,
    mean_steps=1.0,
    redraws=0,
    ms=0.0,
    losses=(0.0, 0.0),
):
    return TaskReport(
        (0.0, 0.0),
        num_transitions,
        mean_steps,
        redraws,
        ms,
        list(train_losses),
        test_losses,
        best_step,
        *losses,
    )


def test_record_by_hand():
    agent = tiny_agent()
    diagnostics = Diagnostics(agent)
    first = report(
        0,
        [1.0, 2.0, 4.0],
        train_losses=[5.0, 1.0],
        num_transitions=30,
        mean_steps=6.0,
        ms=2.0,
        losses=(4, 3),
    )
    second = report(
        1, [3.0, 2.0, 2.5], train_losses=[6.0, 2.0], num_transitions=50, redraws=1, losses=(6, 4)
    )
    diagnostics.add(OuterStep(1, [first]))
    diagnostics.add(OuterStep(2, [second]))
    with torch.no_grad():
        agent.actor.mean.bias.add_(torch.tensor([3.0, 4.0]))
    record = diagnostics.record(agent)
    assert record.means == {
        'inner/best_step': 0.5,
        'inner/rejected': 0.5,
        'inner/one_step': 0.5,
        'inner/first_train_loss': 5.5,
        'inner/last_train_loss': 1.5,
        'inner/first_test_loss': 2.0,
        'inner/best_test_loss': 1.5,
        'inner/last_test_loss': 3.25,
        'inner/initial_loss': 5,
        'inner/expert_loss': 3.5,
        'task/support_transitions': 40,
        'task/mean_steps': 3.5,
        'task/redraws': 0.5,
        'task/filter_ms': 1.0,
        'meta/drift': pytest.approx(5.0, rel=1e-5),
    }
    assert record.samples == {
        'inner/best_steps': [0, 1],
        'task/support_sizes': [30, 50],
        'task/redraw_counts': [0, 1],
    }
    assert record.curves == {
        'inner/train_loss_curve': [5.5, 1.5],
        'inner/test_loss_curve': [2.0, 2.0, 3.25],
    }


def test_each_record_covers_the_steps_since_the_last():
    agent = tiny_agent()
    diagnostics = Diagnostics(agent)
    for best in (4, 6):
        diagnostics.add(OuterStep(1, [report(best, [])]))
        record = diagnostics.record(agent)
        assert record.means['inner/best_step'] == best
        assert record.means['inner/first_test_loss'] is None
        assert record.means['meta/drift'] == 0
        assert list(record.curves) == ['inner/train_loss_curve']
    assert diagnostics.record(agent).means['inner/best_step'] is None


def test_report_takes_its_numbers_from_task_and_result():
    train = SupportSet(np.arange(8), [], np.zeros(0), np.zeros(0), 1, 1, milliseconds=2.5)
    task = MetaTask(
        np.array([1.0, -2.0]), train, train, num_transitions=10, mean_steps=5.0, redraws=3
    )
    result = Adaptation(tiny_agent(), [5.0, 4.0], [3.0, 2.0, 1.0], best_step=2)
    assert TaskReport.of(task, result, 6.0, 1.5) == TaskReport(
        (1.0, -2.0), 10, 5.0, 3, 2.5, [5.0, 4.0], [3.0, 2.0, 1.0], 2, 6.0, 1.5
    )
