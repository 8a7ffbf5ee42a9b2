"""Data-parallel meta-batches: communication between `torch.distributed` processes.

Without an initialised process group there is one process, which sends nothing.
"""

from collections.abc import Iterable, Sequence

import torch
from torch import distributed, Tensor

from metagcttt_core.meta.report import TaskReport
from metagcttt_core.meta.tasks import TaskError


def process() -> tuple[int, int]:
    """The rank of this process and the number of processes."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def first_process() -> bool:
    """True in the process that writes."""
    return process()[0] == 0


def own_tasks(meta_batch_size: int) -> range:
    """Indices of the tasks of a meta-batch that this process adapts to.

    Raises:
        TaskError: If there are more processes than tasks.
    """
    rank, size = process()
    if size > meta_batch_size:
        raise TaskError(
            f'meta_batch_size must be at least the number of processes ({size}), '
            f'got {meta_batch_size}'
        )
    return range(rank, meta_batch_size, size)


def mean_over_tasks(parts: Iterable[Sequence[Tensor]]) -> list[Tensor]:
    """The mean over all tasks of all processes.

    Summed in float64, so that the mean of equal tensors is bit-equal to them and the order of
    the tasks hardly matters.

    Args:
        parts: For each task of this process tensors of the same shapes.
    """
    count = 0
    sums: list[Tensor] = []
    for part in parts:
        count += 1
        if not sums:
            sums = [torch.zeros_like(tensor, dtype=torch.float64) for tensor in part]
            dtypes = [tensor.dtype for tensor in part]
        for total, tensor in zip(sums, part, strict=True):
            total += tensor
    if process()[1] > 1:
        total_count = torch.tensor(count, device=sums[0].device)
        for total in (*sums, total_count):
            distributed.all_reduce(total)
        count = int(total_count)
    return [(total / count).to(dtype) for total, dtype in zip(sums, dtypes, strict=True)]


def reports_of_all(own: list[TaskReport]) -> list[TaskReport]:
    """The reports of all processes, in the order of the tasks' numbers."""
    _, size = process()
    if size == 1:
        return own
    shares: list[list[TaskReport]] = [[] for _ in range(size)]
    distributed.all_gather_object(shares, own)
    count = sum(len(share) for share in shares)
    return [shares[number % size][number // size] for number in range(count)]


def any_process(flag: bool, device: torch.device) -> bool:
    """True if `flag` is true in any process."""
    if process()[1] == 1:
        return flag
    flags = torch.tensor(int(flag), device=device)
    distributed.all_reduce(flags, op=distributed.ReduceOp.MAX)
    return bool(flags)
