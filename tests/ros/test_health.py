from metagcttt.health import Deadlines, Faults, Rate, Samples
import pytest


def test_percentiles_of_the_last_values() -> None:
    samples = Samples(size=100)
    assert (samples.percentile(99), samples.last()) == (0.0, 0.0)
    for value in range(201):
        samples.add(value)
    assert (samples.percentile(0), samples.percentile(100)) == (101, 200)
    assert samples.percentile(50) == pytest.approx(150.5)
    assert samples.last() == 200


def test_rate_counts_the_last_five_seconds() -> None:
    rate = Rate()
    for number in range(100):
        rate.add(number / 10)
    assert rate.per_second(9.9) == pytest.approx(10, abs=0.3)
    assert rate.per_second(99.0) == 0.0
    assert rate.total == 100


def test_deadlines_count_whole_periods_without_an_action() -> None:
    deadlines = Deadlines()
    for now_s in (0.0, 0.1, 0.24, 0.3, 0.7):  # late by less than half a period is not missed
        deadlines.met(now_s, period_s=0.1)
    assert deadlines.total == 3
    assert deadlines.in_last_minute(60.0) == 3
    assert deadlines.in_last_minute(61.0) == 0


def test_pause_misses_no_deadline() -> None:
    deadlines = Deadlines()
    deadlines.met(0.0, period_s=0.1)
    deadlines.pause()
    deadlines.met(10.0, period_s=0.1)
    assert deadlines.total == 0


def test_steps_of_an_episode_without_an_action_are_missed() -> None:
    deadlines = Deadlines()
    for episode_id, step in [(1, 7), (1, 7), (1, 8), (1, 12), (1, 3), (2, 50), (2, 52)]:
        deadlines.answered(0.0, episode_id, step)
    assert deadlines.total == 3 + 1  # 9 to 11; 51
    assert deadlines.in_last_minute(60.0) == 4
    deadlines.pause()
    deadlines.answered(0.0, 2, 99)
    assert deadlines.total == 4


def test_short_fault_is_remembered_for_a_while() -> None:
    faults = Faults()
    faults.note('malformed_states', 'nan', 5.0)
    faults.note('malformed_states', 'inf', 6.0)
    assert faults.counts == {'malformed_states': 2}
    assert (faults.recent(6.9), faults.recent(7.1)) == ('inf', '')
