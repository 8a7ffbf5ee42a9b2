from metagcttt.vectors import vector_fault
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
