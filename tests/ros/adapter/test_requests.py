from collections.abc import Callable, Iterator
import threading

from metagcttt.adapter.requests import Ended, Ending, Request, RequestQueue
from metagcttt_core.adaptation import AdaptationCancelled
from metagcttt_interfaces.msg import Expert
import pytest


class Rig:
    """A queue, and jobs that run until the test lets them go on or the queue stops them."""

    def __init__(self, workers: int = 1, size: int = 2) -> None:
        self._ends = threading.Semaphore(0)
        self.began = threading.Semaphore(0)
        self.go_on = threading.Event()
        self.order: list[Request] = []
        self.queue: RequestQueue[str] = RequestQueue(
            self._ends.release, workers=workers, size=size, num_threads=1
        )

    def submit(self, robot: str, number: int = 1, timeout_s: float = 60.0) -> str:
        request = Request(robot, 7, number)

        def job(should_stop: Callable[[], bool]) -> str:
            self.order.append(request)
            self.began.release()
            while not self.go_on.wait(0.001):
                if should_stop():
                    raise AdaptationCancelled
            return f'{robot} {number}'

        return self.queue.submit(request, job, timeout_s)

    def wait_until_begun(self, count: int = 1) -> None:
        for _ in range(count):
            assert self.began.acquire(timeout=60)

    def ends(self, count: int) -> dict[tuple[str, int], Ended[str]]:
        for _ in range(count):
            assert self._ends.acquire(timeout=60)
        ended = self.queue.take_ended()
        assert len(ended) == count
        return {(each.request.robot, each.request.request_id): each for each in ended}


@pytest.fixture
def make_rig() -> Iterator[Callable[..., Rig]]:
    rigs: list[Rig] = []

    def make(**settings: int) -> Rig:
        rigs.append(Rig(**settings))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.queue.close()


def test_endings_are_those_of_the_message() -> None:
    assert {each.name: each.value for each in Ending} == {
        each.name: getattr(Expert, each.name) for each in Ending
    }


def test_every_request_ends_once_in_order(make_rig) -> None:
    rig = make_rig(size=10)
    assert [rig.submit(robot) for robot in 'abcd'] == [''] * 4
    rig.go_on.set()
    ends = rig.ends(4)
    assert {key: end.result for key, end in ends.items()} == {(r, 1): f'{r} 1' for r in 'abcd'}
    assert {end.ending for end in ends.values()} == {Ending.DONE}
    assert [request.robot for request in rig.order] == [*'abcd']
    assert rig.queue.take_ended() == []
    assert rig.queue.robots() == set()


def test_full_queue_refuses_with_its_numbers_and_keeps_the_others(make_rig) -> None:
    rig = make_rig(workers=2, size=1)
    assert [rig.submit(robot) for robot in 'ab'] == ['', '']
    rig.wait_until_begun(2)
    assert rig.submit('c') == ''
    assert rig.submit('d') == 'the queue is full: 1 requests wait, 2 are worked on'
    assert rig.submit('c', 2) == '', 'the place of the older request'
    rig.go_on.set()
    assert {key: end.ending for key, end in rig.ends(4).items()} == {
        ('a', 1): Ending.DONE,
        ('b', 1): Ending.DONE,
        ('c', 1): Ending.SUPERSEDED,
        ('c', 2): Ending.DONE,
    }


def test_queue_without_places_takes_what_a_worker_is_free_for(make_rig) -> None:
    rig = make_rig(size=0)
    assert rig.submit('a') == ''
    assert rig.submit('b') != ''
    rig.go_on.set()
    rig.ends(1)


def test_newer_request_of_a_robot_stops_the_older_one(make_rig) -> None:
    rig = make_rig()
    rig.submit('a', 1)
    rig.wait_until_begun()
    rig.submit('a', 2)
    rig.wait_until_begun()
    rig.go_on.set()
    ends = rig.ends(2)
    assert [ends['a', number].ending for number in (1, 2)] == [Ending.SUPERSEDED, Ending.DONE]
    assert ends['a', 1].reason == 'superseded by a newer request of the robot'


def test_newer_request_keeps_the_place_in_the_queue(make_rig) -> None:
    rig = make_rig(size=3)
    for robot, number in (('a', 1), ('b', 1), ('c', 1), ('b', 2)):
        rig.submit(robot, number)
        if robot == 'a':
            rig.wait_until_begun()
    rig.go_on.set()
    rig.ends(4)
    assert [(each.robot, each.request_id) for each in rig.order] == [('a', 1), ('b', 2), ('c', 1)]


def test_canceled_requests_end_waiting_or_not(make_rig) -> None:
    rig = make_rig()
    rig.submit('a')
    rig.wait_until_begun()
    rig.submit('b')
    assert rig.queue.cancel(Request('b', 7, 1))
    assert rig.queue.cancel(Request('a', 7, 1))
    assert {end.ending for end in rig.ends(2).values()} == {Ending.CANCELED}
    for other in (Request('a', 7, 1), Request('b', 7, 2), Request('c', 7, 1)):
        assert not rig.queue.cancel(other)


def test_request_ends_when_nobody_waits_any_longer(make_rig) -> None:
    rig = make_rig()
    rig.submit('a')
    rig.wait_until_begun()
    rig.submit('b', timeout_s=1e-6)
    rig.go_on.set()
    ends = rig.ends(2)
    assert ends['b', 1].ending == Ending.TIMED_OUT
    assert [request.robot for request in rig.order] == ['a'], 'it is not even begun'


def test_job_that_fails_ends_its_request_alone(make_rig) -> None:
    rig = make_rig()

    def fail(should_stop: Callable[[], bool]) -> str:
        raise MemoryError('too much')

    rig.queue.submit(Request('a', 7, 1), fail, 60.0)
    rig.go_on.set()
    rig.submit('b')
    ends = rig.ends(2)
    assert (ends['a', 1].ending, ends['a', 1].reason) == (Ending.FAILED, 'MemoryError: too much')
    assert ends['b', 1].ending == Ending.DONE


def test_close_ends_all_and_joins_the_threads() -> None:
    rig = Rig()
    rig.submit('a')
    rig.wait_until_begun()
    rig.submit('b')
    rig.queue.close()
    assert {end.ending for end in rig.ends(2).values()} == {Ending.SHUTDOWN}
    assert not any(t.name.startswith('adaptation') for t in threading.enumerate())
