"""Success statistics and the area under the success curve (appendix E), by hand."""

from itertools import pairwise
import math

from hypothesis import given
from hypothesis import strategies as st
from metagcttt_core import normalized_auc, success_statistics
from metagcttt_core.evaluation import adaptation_efficiency
import numpy as np
import pytest

RATES = st.floats(0, 1)


def test_statistics_by_hand():
    """Mean 0.6, population deviation sqrt(0.08 / 3) over sqrt(3) seeds."""
    result = success_statistics([0.4, 0.6, 0.8])
    assert result.mean == pytest.approx(0.6)
    assert result.standard_error == pytest.approx(math.sqrt(0.08 / 3) / math.sqrt(3))
    assert result.half_width == pytest.approx(1.96 * math.sqrt(0.08) / 3)
    assert result.num_seeds == 3


def test_one_seed_has_no_dispersion():
    assert success_statistics([0.7]) == (0.7, 0.0, 0.0, 1)


@given(st.lists(RATES, min_size=1, max_size=8))
def test_statistics_follow_the_paper(rates):
    mean = sum(rates) / len(rates)
    deviation = math.sqrt(sum((rate - mean) ** 2 for rate in rates) / len(rates))
    result = success_statistics(rates)
    assert result.mean == pytest.approx(mean)
    assert result.standard_error == pytest.approx(deviation / math.sqrt(len(rates)), abs=1e-12)
    assert result.half_width == pytest.approx(1.96 * result.standard_error)
    assert 0 <= result.mean <= 1


@pytest.mark.parametrize(
    ('rates', 'message'),
    [
        ([], r'need one success rate per seed, got shape \(0,\)'),
        ([[0.5]], r'need one success rate per seed, got shape \(1, 1\)'),
        ([0.5, 1.5], r'must be in \[0, 1\], got \[0.5, 1.5\]'),
        ([-0.1], r'must be in \[0, 1\]'),
        ([math.nan], r'must be in \[0, 1\], got \[nan\]'),
    ],
)
def test_wrong_rates_are_refused(rates, message):
    with pytest.raises(ValueError, match=message):
        success_statistics(rates)


def test_auc_by_hand():
    """(0 + 0.5) / 2 x 10 + (0.5 + 1) / 2 x 10 + (1 + 0.6) / 2 x 80, over 100."""
    assert normalized_auc([0, 10, 20, 100], [0.0, 0.5, 1.0, 0.6]) == pytest.approx(0.74)


def test_auc_starts_at_the_first_budget():
    """What lies before the smallest budget counts nothing, as in the paper's sum."""
    assert normalized_auc([50, 100], [1.0, 1.0]) == pytest.approx(0.5)


@pytest.mark.parametrize('rate', [0.0, 0.3, 1.0])
def test_auc_of_a_constant_is_that_constant(rate):
    assert normalized_auc([0, 10, 20, 50, 100, 200], [rate] * 6) == pytest.approx(rate)


@given(
    st.lists(
        st.tuples(st.integers(0, 500), RATES), min_size=2, max_size=7, unique_by=lambda p: p[0]
    )
)
def test_auc_follows_the_paper(points):
    points = sorted(points)
    area = sum(
        (first[1] + second[1]) / 2 * (second[0] - first[0]) for first, second in pairwise(points)
    )
    budgets, rates = zip(*points, strict=True)
    auc = normalized_auc(budgets, rates)
    assert auc == pytest.approx(area / budgets[-1])
    assert 0 <= auc <= 1 + 1e-12


@pytest.mark.parametrize(
    ('budgets', 'rates', 'message'),
    [
        ([0], [0.5], r'two or more budgets with one rate each, got \(1,\) and \(1,\)'),
        ([0, 10], [0.5], r'two or more budgets with one rate each, got \(2,\) and \(1,\)'),
        ([0, 10, 10], [0.5] * 3, 'must ascend strictly from 0 or more'),
        ([10, 0], [0.5] * 2, r'must ascend strictly from 0 or more, got \[10.0, 0.0\]'),
        ([-10, 0], [0.5] * 2, 'must ascend strictly from 0 or more'),
        ([0, math.nan], [0.5] * 2, 'must ascend strictly from 0 or more'),
        ([0, math.inf], [0.5] * 2, 'must ascend strictly from 0 or more'),
        ([0, 10], [0.5, 1.1], r'must be in \[0, 1\], got \[0.5, 1.1\]'),
        ([0, 10], [0.5, math.nan], r'must be in \[0, 1\]'),
    ],
)
def test_wrong_curve_is_refused(budgets, rates, message):
    with pytest.raises(ValueError, match=message):
        normalized_auc(budgets, rates)


@pytest.mark.parametrize(
    ('baseline', 'method', 'expected'),
    [
        ({0: 0.1, 50: 0.7, 100: 0.8}, {0: 0.2, 20: 0.8, 50: 0.9}, 5.0),
        ({0: 0.1, 100: 0.9}, {0: 0.1, 100: 0.9}, 1.0),
        ({0: 0.1, 10: 0.9}, {0: 0.1, 50: 0.9}, 0.2),
        ({0: 0.1, 10: 0.9}, {0: 0.85}, math.inf),
        ({0: 0.9}, {0: 0.1, 10: 0.9}, 0.0),
        ({0: 0.9}, {0: 0.9}, None),
        ({0: 0.1, 100: 0.7}, {0: 0.1, 10: 0.9}, None),
        ({0: 0.1, 100: 0.9}, {0: 0.1, 10: 0.7}, None),
        # The smallest sufficient budget, wherever it stands and whatever comes after.
        ({200: 0.9, 100: 0.85, 0: 0.0}, {50: 0.8, 100: 0.2}, 2.0),
    ],
)
def test_adaptation_efficiency(baseline, method, expected):
    assert adaptation_efficiency(baseline, method) == expected


def test_adaptation_efficiency_at_another_threshold():
    curves = {0: 0.1, 10: 0.4, 100: 0.6}, {0: 0.1, 5: 0.5}
    assert adaptation_efficiency(*curves, threshold=0.5) == 20
    assert adaptation_efficiency(*curves, threshold=0.4) == 2
    assert adaptation_efficiency(*curves) is None
    assert np.isinf(adaptation_efficiency({5: 0.5}, {0: 0.5}, threshold=0.5))
