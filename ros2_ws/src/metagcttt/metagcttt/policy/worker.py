"""The background thread of the policy node; the newest job wins."""

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
    """Runs one job at a time in a background thread.

    The thread that starts the jobs collects their results with `take_finished`, so that its state
    needs no locks.
    """

    def __init__(self, on_finished: Callable[[], None], num_threads: int) -> None:
        """Create the thread pool.

        Args:
            on_finished: Called from the background thread whenever a job has ended.
            num_threads: PyTorch threads per job; 0: PyTorch's default.
        """
        self._on_finished = on_finished
        self._finished: deque[tuple[Key, Future[Result]]] = deque()
        self._cancel_current = threading.Event()
        self._current: Future[Result] | None = None
        self.num_pending = 0  # jobs whose result was not collected yet
        # PyTorch keeps the number per thread.
        self._pool = ThreadPoolExecutor(
            max_workers=1,
            thread_name_prefix='adaptation',
            initializer=partial(torch.set_num_threads, num_threads) if num_threads else None,
        )

    def start(self, key: Key, job: Callable[[Callable[[], bool]], Result]) -> None:
        """Cancel the job under way and run `job`.

        Args:
            key: Returned with the result.
            job: Called with a function that returns true when the job is cancelled.
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
        """Cancel the job under way; it ends within one gradient step."""
        self._cancel_current.set()
        if self._current is not None:
            self._current.cancel()  # if it has not started

    def take_finished(self) -> list[tuple[Key, 'Future[Result]']]:
        """The keys and futures of the jobs that ended since the last call, cancelled ones too."""
        taken = []
        while self._finished:
            taken.append(self._finished.popleft())
        self.num_pending -= len(taken)
        return taken

    def close(self) -> None:
        """Cancel and join the thread."""
        self.cancel()
        self._pool.shutdown(wait=True, cancel_futures=True)
