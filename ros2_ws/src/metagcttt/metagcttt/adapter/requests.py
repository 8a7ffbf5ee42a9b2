"""The requests that an adapter works on: a bounded queue and the threads that empty it."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
import threading
import time
from typing import Generic, TypeVar

from metagcttt_core.adaptation import AdaptationCancelled
import torch

Result = TypeVar('Result')
Job = Callable[[Callable[[], bool]], Result]
"""Called with a function that returns true when the job is to stop by `AdaptationCancelled`."""


class Ending(IntEnum):
    """How a request ended; the constants of the message `Expert`."""

    DONE = 0
    FAILED = 1
    SUPERSEDED = 2
    CANCELED = 3
    TIMED_OUT = 4
    SHUTDOWN = 5


@dataclass(frozen=True)
class Request:
    """A request of a robot.

    Attributes:
        robot: The name of the node that asks; one request of each is worked on.
        instance: The number that this node has drawn.
        request_id: The number of its request.
    """

    robot: str
    instance: int
    request_id: int


@dataclass(frozen=True)
class Ended(Generic[Result]):
    """A request that has ended.

    Attributes:
        request: The request.
        ending: How.
        reason: Why, where it is not done.
        result: What its job returned, where it is done.
        wait_ms: Time in the queue.
    """

    request: Request
    ending: Ending
    reason: str
    result: Result | None
    wait_ms: float


class _Work(Generic[Result]):
    """A request under way, waiting or running."""

    def __init__(self, request: Request, job: Job[Result], timeout_s: float) -> None:
        self.request, self.job = request, job
        self.asked_s = time.monotonic()
        self.end_s = self.asked_s + timeout_s
        self.dropped: Ending | None = None  # set from outside; the job then stops

    def should_stop(self) -> bool:
        return self.dropped is not None or time.monotonic() > self.end_s


class RequestQueue(Generic[Result]):
    """Works on requests in their order, as many at a time as there are workers.

    A newer request of a robot supersedes the older one, whose place in the queue it takes. Every
    request that was accepted ends, once; the thread that submits collects the ends.
    """

    def __init__(
        self, on_ended: Callable[[], None], *, workers: int, size: int, num_threads: int
    ) -> None:
        """Start without requests.

        Args:
            on_ended: Called, from any thread, whenever a request has ended; calls nothing here.
            workers: Requests worked on at a time.
            size: Requests that wait at most.
            num_threads: PyTorch threads of each worker; 0: PyTorch's default.
        """
        self._on_ended = on_ended
        self._workers, self._size = workers, size
        self._lock = threading.Lock()
        self._waiting: dict[str, _Work[Result]] = {}  # by robot, in their order
        self._running: set[_Work[Result]] = set()
        self._ended: deque[Ended[Result]] = deque()
        # PyTorch keeps the number per thread.
        self._pool = ThreadPoolExecutor(
            max_workers=workers,
            thread_name_prefix='adaptation',
            initializer=partial(torch.set_num_threads, num_threads) if num_threads else None,
        )

    @property
    def num_waiting(self) -> int:
        """Requests that wait for a worker."""
        return len(self._waiting)

    @property
    def num_running(self) -> int:
        """Requests that are worked on."""
        return len(self._running)

    def submit(self, request: Request, job: Job[Result], timeout_s: float) -> str:
        """Queue a request.

        Args:
            request: The request.
            job: What to do, in a thread of a worker.
            timeout_s: Nobody waits for the result any longer than that.

        Returns:
            Why it is refused; empty when it is queued.
        """
        work = _Work(request, job, timeout_s)
        with self._lock:
            older = self._waiting.get(request.robot)
            full = len(self._waiting) + len(self._running) >= self._workers + self._size
            if older is None and full:
                return (
                    f'the queue is full: {len(self._waiting)} requests wait, '
                    f'{len(self._running)} are worked on'
                )
            self._drop(request.robot, Ending.SUPERSEDED)
            self._waiting[request.robot] = work
        if older is None:
            self._pool.submit(self._work)
        else:
            self._end(older, Ending.SUPERSEDED)
        return ''

    def cancel(self, request: Request) -> bool:
        """Drop a request; whether there was one to drop."""
        with self._lock:
            work = self._waiting.get(request.robot)
            if work is None or work.request != request:
                running = [work for work in self._running if work.request == request]
                for each in running:
                    each.dropped = each.dropped or Ending.CANCELED
                return bool(running)
            del self._waiting[request.robot]
        self._end(work, Ending.CANCELED)
        return True

    def has(self, request: Request) -> bool:
        """Whether a request waits or is worked on."""
        with self._lock:
            works = [*self._waiting.values(), *self._running]
            return any(work.request == request and work.dropped is None for work in works)

    def robots(self) -> set[str]:
        """The robots with a request under way."""
        with self._lock:
            return {*self._waiting, *(work.request.robot for work in self._running)}

    def take_ended(self) -> list[Ended[Result]]:
        """The requests that ended since the last call."""
        taken = []
        while self._ended:
            taken.append(self._ended.popleft())
        return taken

    def close(self) -> None:
        """End all requests and join the threads."""
        with self._lock:
            waiting = list(self._waiting.values())
            self._waiting.clear()
            for work in self._running:
                work.dropped = work.dropped or Ending.SHUTDOWN
        for work in waiting:
            self._end(work, Ending.SHUTDOWN)
        self._pool.shutdown(wait=True)

    def _drop(self, robot: str, ending: Ending) -> None:
        for work in self._running:
            if work.request.robot == robot:
                work.dropped = work.dropped or ending

    def _work(self) -> None:
        """Work on the request that has waited longest, unless it was dropped."""
        with self._lock:
            if not self._waiting:
                return
            work = self._waiting.pop(next(iter(self._waiting)))
            self._running.add(work)
        wait_ms = 1e3 * (time.monotonic() - work.asked_s)
        result, failure = None, ''
        try:
            if not work.should_stop():
                result = work.job(work.should_stop)
        except AdaptationCancelled:
            pass
        except Exception as error:  # noqa: BLE001 - whatever a request does, the adapter goes on
            failure = f'{type(error).__name__}: {error}'
        with self._lock:
            self._running.discard(work)
            if work.dropped is not None:
                self._end(work, work.dropped, wait_ms=wait_ms)
            elif failure:
                self._end(work, Ending.FAILED, failure, wait_ms=wait_ms)
            elif result is None:
                self._end(work, Ending.TIMED_OUT, wait_ms=wait_ms)
            else:
                self._end(work, Ending.DONE, result=result, wait_ms=wait_ms)

    def _end(
        self,
        work: _Work[Result],
        ending: Ending,
        failure: str = '',
        *,
        result: Result | None = None,
        wait_ms: float | None = None,
    ) -> None:
        if wait_ms is None:
            wait_ms = 1e3 * (time.monotonic() - work.asked_s)
        reason = _REASONS.get(ending, failure)
        self._ended.append(Ended(work.request, ending, reason, result, wait_ms))
        self._on_ended()


_REASONS = {
    Ending.SUPERSEDED: 'superseded by a newer request of the robot',
    Ending.CANCELED: 'canceled by the robot',
    Ending.TIMED_OUT: 'not done before the time was up that the robot waits',
    Ending.SHUTDOWN: 'the adapter was ended',
}
