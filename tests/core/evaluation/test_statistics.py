"""Success statistics and the area under the success curve (appendix E), by hand."""

from itertools import pairwise
import math

from hypothesis import given
from hypothesis import strategies as st
from metagcttt_core import normalized_auc, success_statistics
from metagcttt_core.evaluation import (
    adaptation_efficiency,
    interquartile_mean,
    probability_of_improvement,
    stratified_bootstrap,
)
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


def test_interquartile_mean_by_hand():
    """Of eight scores the two lowest and the two highest go; of five, one each."""
    assert interquartile_mean(np.array([[0.0, 1.0, 0.1, 0.9], [0.2, 0.3, 0.4, 0.5]])) == (
        pytest.approx((0.2 + 0.3 + 0.4 + 0.5) / 4)
    )
    assert interquartile_mean(np.array([0.0, 0.3, 0.6, 0.9, 100])) == pytest.approx(0.6)
    assert interquartile_mean(np.array([0.25])) == 0.25


@given(st.lists(RATES, min_size=1, max_size=30))
def test_interquartile_mean_is_the_trimmed_one_of_scipy(rates):
    from scipy.stats import trim_mean

    assert interquartile_mean(np.array(rates)) == pytest.approx(trim_mean(rates, 0.25))


def test_probability_of_improvement_by_hand():
    """Task 1: of four pairs three are above, one equal; task 2: none, one equal."""
    scores = np.array([[0.5, 0.0], [0.9, 0.1]])
    baseline = np.array([[0.5, 0.1], [0.4, 0.2]])
    assert probability_of_improvement(scores, baseline) == pytest.approx((3.5 / 4 + 0.5 / 4) / 2)
    assert probability_of_improvement(scores, scores) == 0.5
    assert probability_of_improvement(scores[:1], baseline) == pytest.approx((1.5 / 2 + 0) / 2)


def test_probability_of_improvement_is_the_statistic_of_mann_and_whitney():
    from scipy.stats import mannwhitneyu

    rng = np.random.default_rng(0)
    scores, baseline = rng.integers(0, 5, size=(4, 3)), rng.integers(0, 5, size=(6, 3))
    expected = [
        mannwhitneyu(*each).statistic / 24 for each in zip(scores.T, baseline.T, strict=True)
    ]
    assert probability_of_improvement(scores, baseline) == pytest.approx(np.mean(expected))


def test_bootstrap_draws_seeds_within_each_task():
    """Tasks differ and seeds do not, so every draw is the same matrix: no spread."""
    equal = np.tile([0.0, 0.5, 1.0], (4, 1))
    assert stratified_bootstrap(np.mean, equal) == (0.5, 0.5, 0.5)
    # Two seeds of one task: the mean of a draw is 0, 0.5 or 1 with probability 1/4, 1/2, 1/4.
    two = np.array([[0.0], [1.0]])
    assert stratified_bootstrap(np.mean, two) == (0.5, 0.0, 1.0)
    assert stratified_bootstrap(np.mean, two, confidence=0.4) == (0.5, 0.5, 0.5)


def test_bootstrap_interval_is_that_of_the_normal_distribution_for_many_seeds():
    scores = np.random.default_rng(0).normal(size=(400, 5))
    value, low, high = stratified_bootstrap(np.mean, scores)
    error = scores.std(axis=0).mean() / math.sqrt(scores.size)
    assert (high - value, value - low) == (
        pytest.approx(1.96 * error, rel=0.1),
        pytest.approx(1.96 * error, rel=0.1),
    )
    assert stratified_bootstrap(np.mean, scores) == (value, low, high)  # the same draws


def test_bootstrap_needs_seeds_and_tasks():
    with pytest.raises(ValueError, match=r'shape \(seeds, tasks\), got \(3,\)'):
        stratified_bootstrap(np.mean, np.zeros(3))
