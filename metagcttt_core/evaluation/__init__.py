"""Evaluation: rollouts, success statistics, the area under the success curve."""

from typing import TYPE_CHECKING

from metagcttt_core.lazy import exports

if TYPE_CHECKING:
    from metagcttt_core.evaluation.rollout import Episode, evaluate_success, run_episode
    from metagcttt_core.evaluation.statistics import (
        adaptation_efficiency,
        normalized_auc,
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
                'normalized_auc',
                'success_statistics',
                'SuccessStatistics',
            ),
        },
    )

__all__ = [
    'Episode',
    'SuccessStatistics',
    'adaptation_efficiency',
    'evaluate_success',
    'normalized_auc',
    'run_episode',
    'success_statistics',
]
