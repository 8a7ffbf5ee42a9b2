"""Adaptation beside the control loop: one thread, and the newest job wins."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
import threading
from typing import Generic, TypeVar

import torch

Key = TypeVar('Key')
Result = TypeVar('Result')


class AdaptationWorker(Generic[Key, Result]):
    """Runs one job at a time in a thread of its own.

    Results are collected with `take_finished` by the thread that started the jobs, so that its
    state needs no locks.
    """

    def __init__(self, on_finished: Callable[[], None], num_threads: int) -> None:
        """Start nothing yet.

        Args:
            on_finished: Called from the worker's thread whenever a job has ended.
            num_threads: Threads that PyTorch uses for a job; 0 leaves its own choice.
        """
        self._on_finished = on_finished
        self._finished: deque[tuple[Key, Future[Result]]] = deque()
        self._cancel_current = threading.Event()
        self._current: Future[Result] | None = None
        self.num_pending = 0  # jobs whose results were not collected yet
        # PyTorch keeps the number per thread.
        self._pool = ThreadPoolExecutor(
            max_workers=1,
            thread_name_prefix='adaptation',
            initializer=partial(torch.set_num_threads, num_threads) if num_threads else None,
        )

    def start(self, key: Key, job: Callable[[Callable[[], bool]], Result]) -> None:
        """Run `job` after cancelling the job under way.

        Args:
            key: Handed back with the result.
            job: Called with a function that says whether to give up.
        """
        self.cancel()
        self.num_pending += 1
        cancelled = self._cancel_current = threading.Event()
        self._current = self._pool.submit(job, cancelled.is_set)

        def collect(future: 'Future[Result]') -> None:
            self._finished.append((key, future))
            self._on_finished()

        self._current.add_done_callback(collect)

    def cancel(self) -> None:
        """Ask the job under way to give up; it ends within one gradient step."""
        self._cancel_current.set()
        if self._current is not None:
            self._current.cancel()  # when it has not begun

    def take_finished(self) -> list[tuple[Key, 'Future[Result]']]:
        """Jobs that ended since the last call, also cancelled ones."""
        taken = []
        while self._finished:
            taken.append(self._finished.popleft())
        self.num_pending -= len(taken)
        return taken

    def close(self) -> None:
        """Cancel and wait for the thread to end."""
        self.cancel()
        self._pool.shutdown(wait=True, cancel_futures=True)
