from metagcttt.input_checks import Senders, vector_fault
import numpy as np
import pytest


@pytest.mark.parametrize(
    ('values', 'fault'),
    [
        ([1.0, 2.0], ''),
        ([1e39, 0.0], 'the state is not finite: [1e+39, 0.0]'),
        ([1.0], 'the state has 1 values, 2 are needed'),
        ([], 'the state has 0 values, 2 are needed'),
        ([1.0, np.nan], 'the state is not finite: [1.0, nan]'),
        ([-np.inf, 0.0], 'the state is not finite: [-inf, 0.0]'),
    ],
)
def test_vector_fault(values: list[float], fault: str) -> None:
    assert vector_fault('the state', np.array(values, dtype=np.float64), 2) == fault


def test_senders_are_forgotten_after_a_second_of_silence() -> None:
    senders = Senders()
    assert senders.count(0.0) == 0
    for instance, now_s in [(1, 0.0), (2, 0.3), (1, 0.6)]:
        senders.saw(instance, now_s)
    assert [senders.count(now_s) for now_s in (0.6, 1.3, 1.31, 1.6, 1.7)] == [2, 2, 1, 1, 0]
