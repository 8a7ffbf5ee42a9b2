from collections.abc import Iterator
import threading

from metagcttt.policy.worker import AdaptationWorker
import pytest
import torch


class Rig:
    """A worker and a count of its calls."""

    def __init__(self, num_threads: int = 0) -> None:
        self._calls = threading.Semaphore(0)
        self.worker = AdaptationWorker(self._calls.release, num_threads)

    def results(self, count: int) -> list:
        """Key and result of the next `count` jobs; the exception's type where one failed."""
        for _ in range(count):
            assert self._calls.acquire(timeout=10)
        return [
            (
                key,
                'cancelled'
                if f.cancelled()
                else type(f.exception())
                if f.exception()
                else f.result(),
            )
            for key, f in self.worker.take_finished()
        ]


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.worker.close()


def wait_until_stopped(should_stop) -> str:
    while not should_stop():
        pass
    return 'stopped'


def test_result_comes_back_with_its_key(rig: Rig) -> None:
    rig.worker.start('a', lambda should_stop: 1)
    assert rig.results(1) == [('a', 1)]
    assert rig.worker.take_finished() == []


def test_jobs_run_in_another_thread(rig: Rig) -> None:
    rig.worker.start('a', lambda should_stop: threading.current_thread().name)
    [(_, name)] = rig.results(1)
    assert name.startswith('adaptation')


def test_failure_comes_back(rig: Rig) -> None:
    rig.worker.start('a', lambda should_stop: 1 // 0)
    assert rig.results(1) == [('a', ZeroDivisionError)]


def test_newer_job_stops_the_one_under_way_and_replaces_the_waiting_one(rig: Rig) -> None:
    began = threading.Event()

    def first(should_stop) -> str:
        began.set()
        return wait_until_stopped(should_stop)

    rig.worker.start('a', first)
    assert began.wait(10)
    rig.worker.start('b', lambda should_stop: 'b')
    rig.worker.start('c', lambda should_stop: 'c')
    results = dict(rig.results(3))
    assert (results['a'], results['c']) == ('stopped', 'c')
    assert results['b'] in ('cancelled', 'b')


def test_cancel_stops_the_job_under_way(rig: Rig) -> None:
    rig.worker.start('a', wait_until_stopped)
    rig.worker.cancel()
    assert rig.results(1)[0][1] in ('stopped', 'cancelled')


def test_close_waits_for_the_thread() -> None:
    rig = Rig()
    rig.worker.start('a', wait_until_stopped)
    rig.worker.close()
    assert not any(t.name.startswith('adaptation') for t in threading.enumerate())


def test_number_of_threads_holds_in_the_worker() -> None:
    before = torch.get_num_threads()
    rig = Rig(num_threads=3)
    rig.worker.start('a', lambda should_stop: torch.get_num_threads())
    assert rig.results(1) == [('a', 3)]
    rig.worker.close()
    torch.set_num_threads(before)
