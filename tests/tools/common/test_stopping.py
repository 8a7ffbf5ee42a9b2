"""Runs that are told to end: what is left, and whether they want to be queued again."""

import signal

from metagcttt_tools.common.stopping import INTERRUPTED, REQUEUE, Stop, stop_on_signal
import pytest


@pytest.mark.parametrize(
    ('number', 'status'),
    [(signal.SIGINT, INTERRUPTED), (signal.SIGTERM, REQUEUE), (signal.SIGUSR1, REQUEUE)],
)
def test_signal_asks_for_the_end_and_decides_the_status(number, status):
    before = signal.getsignal(number)
    with stop_on_signal() as stop:
        assert not stop.is_set()
        signal.raise_signal(number)
        assert stop.is_set()
        signal.raise_signal(signal.SIGTERM if number == signal.SIGINT else signal.SIGINT)
        assert stop.status == status  # what came first
    assert signal.getsignal(number) is before


def test_time_limit_asks_for_another_turn():
    assert not Stop(time_limit=1e6).is_set()
    stop = Stop(time_limit=1e-9)
    assert stop.wait(0)
    assert stop.status == REQUEUE
