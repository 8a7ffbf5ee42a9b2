"""Evaluation: rollouts, success statistics, the area under the success curve."""

from typing import TYPE_CHECKING

from metagcttt_core.lazy import exports

if TYPE_CHECKING:
    from metagcttt_core.evaluation.rollout import Episode, evaluate_success, run_episode
    from metagcttt_core.evaluation.statistics import (
        adaptation_efficiency,
        interquartile_mean,
        Interval,
        normalized_auc,
        probability_of_improvement,
        stratified_bootstrap,
        success_statistics,
        SuccessStatistics,
    )
else:
    __getattr__ = exports(
        __name__,
        {
            'rollout': ('Episode', 'evaluate_success', 'run_episode'),
            'statistics': (
                'adaptation_efficiency',
                'interquartile_mean',
                'Interval',
                'normalized_auc',
                'probability_of_improvement',
                'stratified_bootstrap',
                'success_statistics',
                'SuccessStatistics',
            ),
        },
    )

__all__ = [
    'Episode',
    'Interval',
    'SuccessStatistics',
    'adaptation_efficiency',
    'evaluate_success',
    'interquartile_mean',
    'normalized_auc',
    'probability_of_improvement',
    'run_episode',
    'stratified_bootstrap',
    'success_statistics',
]
