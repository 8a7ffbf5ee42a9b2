from metagcttt.sim.pacing import Pacer
import numpy as np
import pytest


def test_one_step_for_every_tick_of_a_jittering_timer() -> None:
    rng = np.random.default_rng(0)
    pacer = Pacer(period_s=0.1, now_s=5.0)
    ticks = 5.0 + 0.1 * np.arange(1, 1001) + rng.uniform(-0.03, 0.03, 1000)
    assert {pacer.due(tick) for tick in ticks} == {1}


def test_delays_do_not_add_up() -> None:
    pacer = Pacer(period_s=0.1, now_s=0.0)
    rng = np.random.default_rng(0)
    now, steps = 0.0, 0
    while now < 60.0:
        now += 0.1 + rng.exponential(0.02)  # every tick is late
        steps += pacer.due(now)
    assert steps * 0.1 == pytest.approx(now, abs=0.1)
    assert pacer.num_lost == 0


def test_missed_ticks_are_made_up_for_little_by_little() -> None:
    pacer = Pacer(period_s=0.1, now_s=0.0)
    assert [pacer.due(now) for now in (0.1, 0.5, 0.6, 0.7, 0.8, 0.9)] == [1, 2, 2, 2, 1, 1]
    assert pacer.num_lost == 0


def test_long_delay_is_lost_and_counted() -> None:
    pacer = Pacer(period_s=0.1, now_s=0.0, max_lag_s=0.5)
    ticks = np.arange(3.0, 4.05, 0.1)
    assert sum(pacer.due(now) for now in ticks) == 5 + 10
    assert pacer.num_lost == 25


def test_period_longer_than_the_lag_still_steps() -> None:
    pacer = Pacer(period_s=2.0, now_s=0.0, max_lag_s=0.5)
    assert [pacer.due(now) for now in (0.9, 2.0, 4.0)] == [0, 1, 1]


def test_clock_that_goes_back_makes_no_step() -> None:
    pacer = Pacer(period_s=0.1, now_s=10.0)
    assert [pacer.due(now) for now in (10.1, 9.0, 10.2)] == [1, 0, 1]
