"""Success statistics and the area under the success curve (paper, appendix E).

Interquartile means, stratified bootstrap intervals and the probability of improvement are those
of Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, 2021.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np


class SuccessStatistics(NamedTuple):
    """Mean success over seeds with its uncertainty.

    Attributes:
        mean: Mean success rate.
        standard_error: Population standard deviation over the square root of the number of seeds.
        half_width: Half the 95 percent confidence interval, 1.96 standard errors.
        num_seeds: Number of seeds.
    """

    mean: float
    standard_error: float
    half_width: float
    num_seeds: int


def success_statistics(success_rates: Sequence[float]) -> SuccessStatistics:
    """Statistics of one success rate per seed.

    Raises:
        ValueError: For no seeds, or a rate outside [0, 1].
    """
    rates = np.asarray(success_rates, dtype=np.float64)
    if rates.ndim != 1 or not len(rates):
        raise ValueError(f'need one success rate per seed, got shape {rates.shape}')
    if not np.all((rates >= 0) & (rates <= 1)):
        raise ValueError(f'success rates must be in [0, 1], got {rates.tolist()}')
    error = float(rates.std(ddof=0) / np.sqrt(len(rates)))
    return SuccessStatistics(float(rates.mean()), error, 1.96 * error, len(rates))


class Interval(NamedTuple):
    """An estimate with the ends of its interval."""

    value: float
    low: float
    high: float


def interquartile_mean(scores: np.ndarray) -> float:
    """The mean without the lowest and the highest quarter, each rounded down to whole scores.

    Args:
        scores: (seeds, tasks) or any other shape; all count alike.
    """
    ordered = np.sort(scores, axis=None)
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())


def probability_of_improvement(scores: np.ndarray, baseline: np.ndarray) -> float:
    """How likely a run scores more than one of the baseline on the same task.

    The mean over tasks of the Mann-Whitney statistic: a draw counts half, runs are not paired.

    Args:
        scores: (seeds, tasks).
        baseline: (its seeds, tasks).
    """
    above = scores[:, None] > baseline[None]
    equal = scores[:, None] == baseline[None]
    return float((above + 0.5 * equal).mean())


def stratified_bootstrap(
    statistic: Callable[..., float],
    *scores: np.ndarray,
    confidence: float = 0.95,
    repeats: int = 2000,
    seed: int = 0,
) -> Interval:
    """A statistic with its percentile interval over seeds drawn anew for each task.

    Args:
        statistic: Of as many score matrices.
        *scores: (seeds, tasks) each; the tasks are the same, and are kept.
        confidence: Share of the draws inside the interval.
        repeats: Number of draws.
        seed: Of the draws.

    Raises:
        ValueError: If a matrix is not two-dimensional, or empty.
    """
    for matrix in scores:
        if matrix.ndim != 2 or not matrix.size:
            raise ValueError(f'need scores of shape (seeds, tasks), got {matrix.shape}')
    rng = np.random.default_rng(seed)
    draws = [
        statistic(
            *(np.take_along_axis(m, rng.integers(len(m), size=m.shape), axis=0) for m in scores)
        )
        for _ in range(repeats)
    ]
    tail = 50 * (1 - confidence)
    low, high = np.percentile(draws, [tail, 100 - tail])
    return Interval(statistic(*scores), float(low), float(high))


def normalized_auc(budgets: Sequence[float], success_rates: Sequence[float]) -> float:
    """Area under success over test-time training steps, divided by the largest budget.

    Args:
        budgets: (n,) numbers of steps, strictly ascending from 0 or more, at least two.
        success_rates: (n,) mean success rate at each budget.

    Raises:
        ValueError: If the lengths differ or the budgets do not ascend.
    """
    x = np.asarray(budgets, dtype=np.float64)
    y = np.asarray(success_rates, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape or len(x) < 2:
        raise ValueError(
            f'need two or more budgets with one rate each, got {x.shape} and {y.shape}'
        )
    if not (np.isfinite(x).all() and x[0] >= 0 and np.all(np.diff(x) > 0)):
        raise ValueError(f'budgets must ascend strictly from 0 or more, got {x.tolist()}')
    if not np.all((y >= 0) & (y <= 1)):
        raise ValueError(f'success rates must be in [0, 1], got {y.tolist()}')
    return float(np.trapezoid(y, x) / x[-1])


def adaptation_efficiency(
    baseline: Mapping[int, float], method: Mapping[int, float], threshold: float = 0.8
) -> float | None:
    """Ratio of the steps that baseline and method need to reach a success rate.

    Args:
        baseline: Mean success rate by budget.
        method: The same for the method.
        threshold: The success rate to reach.

    Returns:
        The smallest sufficient budget of the baseline over that of the method; infinite when only
        the method needs none; None when either never reaches the threshold or neither needs a
        step.
    """
    reached = [
        min((budget for budget, rate in curve.items() if rate >= threshold), default=None)
        for curve in (baseline, method)
    ]
    if reached[0] is None or reached[1] is None or reached == [0, 0]:
        return None
    return float('inf') if reached[1] == 0 else reached[0] / reached[1]
