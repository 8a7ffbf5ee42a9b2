"""Post-trained policies against the base policies that they began as, seed by seed."""

from collections.abc import Sequence
import math
from typing import Any, NamedTuple

from metagcttt_core import normalized_auc
from metagcttt_core.evaluation import adaptation_efficiency
import numpy as np

_CONFIDENCE = 0.95
_AREAS = (50, 200)  # the paper's on navigate and on stitch data


class Difference(NamedTuple):
    """A mean difference with half its interval; None where one seed gives no interval."""

    mean: float
    half_width: float | None

    def __str__(self) -> str:
        """The difference with its interval, and a star where that excludes 0."""
        if self.half_width is None:
            return f'{self.mean:+.3f}'
        star = '*' if abs(self.mean) > self.half_width else ''
        return f'{self.mean:+.3f} ± {self.half_width:.3f}{star}'


def paired_difference(base: Sequence[float], other: Sequence[float]) -> Difference:
    """The mean of other - base with the 95 percent interval of Student's t over the pairs.

    Args:
        base: One figure for each training seed.
        other: The figure of the policy that was trained on from it, in the same order.
    """
    from scipy.stats import t

    differences = np.subtract(other, base)
    count = len(differences)
    if count < 2:
        return Difference(float(differences.mean()), None)
    error = differences.std(ddof=1) / math.sqrt(count)
    quantile = t.ppf((1 + _CONFIDENCE) / 2, count - 1)
    return Difference(float(differences.mean()), float(quantile * error))


def differences(
    base: dict[str, Any], arm: dict[str, Any], threshold: float
) -> tuple[dict[str, Difference], list[float | None]]:
    """Differences by budget and by area under the curve, and the efficiency of each seed.

    Args:
        base: Summary of the base policies in a report: `seeds`, `budgets` and `per_seed`.
        arm: Summary of an arm, of some of the same seeds.
        threshold: Success rate that adaptation efficiency counts steps to.
    """
    budgets = arm['budgets']
    chosen = [base['seeds'].index(seed) for seed in arm['seeds']]
    before, after = np.array(base['per_seed'])[:, chosen], np.array(arm['per_seed'])
    found = {
        f'K = {budget}': paired_difference(*rates)
        for budget, *rates in zip(budgets, before, after, strict=True)
    }
    for last in _AREAS:
        if last in budgets[1:]:
            areas = [_areas(budgets, rates, last) for rates in (before, after)]
            found[f'AUC to {last}'] = paired_difference(*areas)
    efficiency = [
        adaptation_efficiency(
            dict(zip(budgets, base_rates, strict=True)),
            dict(zip(budgets, arm_rates, strict=True)),
            threshold,
        )
        for base_rates, arm_rates in zip(before.T, after.T, strict=True)
    ]
    return found, efficiency


def _areas(budgets: Sequence[int], rates: np.ndarray, last: int) -> list[float]:
    """The area of each seed under the curve up to the budget `last`."""
    count = budgets.index(last) + 1
    return [normalized_auc(budgets[:count], seed[:count]) for seed in rates.T]
