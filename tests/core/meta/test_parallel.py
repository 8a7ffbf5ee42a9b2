"""Which process does what, and means over tasks."""

import itertools

from metagcttt_core.meta import parallel, TaskError
from metagcttt_core.meta.parallel import any_process, mean_over_tasks, own_tasks, reports_of_all
import pytest
import torch


@pytest.mark.parametrize(('tasks', 'processes'), [(1, 1), (4, 2), (5, 3), (3, 3)])
def test_every_task_belongs_to_one_process(tasks, processes, monkeypatch):
    shares = []
    for rank in range(processes):
        monkeypatch.setattr(parallel, 'process', lambda rank=rank: (rank, processes))
        shares.append(list(own_tasks(tasks)))
    assert sorted(itertools.chain(*shares)) == list(range(tasks))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_more_processes_than_tasks_are_refused(monkeypatch):
    monkeypatch.setattr(parallel, 'process', lambda: (0, 3))
    message = r'meta_batch_size must be at least the number of processes \(3\), got 2'
    with pytest.raises(TaskError, match=message):
        own_tasks(2)


def test_one_process_has_all_reports_and_its_own_flag():
    assert reports_of_all([]) == []
    device = torch.device('cpu')
    assert any_process(True, device)
    assert not any_process(False, device)


def test_mean_by_hand():
    parts = [
        [torch.tensor([1.0, 5.0]), torch.tensor(-1.0)],
        [torch.tensor([2.0, 6.0]), torch.tensor(3.0)],
    ]
    first, second = mean_over_tasks(parts)
    assert first.tolist() == [1.5, 5.5]
    assert second.item() == 1.0
    assert first.dtype == torch.float32


def test_mean_of_equal_tensors_is_that_tensor_and_order_does_not_matter():
    generator = torch.Generator().manual_seed(0)
    tensors = [torch.randn(1000, generator=generator) for _ in range(7)]
    (same,) = mean_over_tasks([tensors[0]] for _ in range(7))
    assert torch.equal(same, tensors[0])
    (forward,) = mean_over_tasks([tensor] for tensor in tensors)
    (backward,) = mean_over_tasks([tensor] for tensor in reversed(tensors))
    assert torch.equal(forward, backward)
