"""Meta-GC-TTT: offline goal-conditioned policies that adapt at test time."""

from typing import TYPE_CHECKING

from metagcttt_core.lazy import exports

if TYPE_CHECKING:
    from metagcttt_core.adaptation.adapt import adapt
    from metagcttt_core.adaptation.config import TTTConfig
    from metagcttt_core.adaptation.result import Adaptation
    from metagcttt_core.agents.agent import Agent
    from metagcttt_core.agents.registry import make_agent
    from metagcttt_core.data.dataset import TrajectoryDataset
    from metagcttt_core.data.errors import DatasetError
    from metagcttt_core.evaluation.rollout import evaluate_success
    from metagcttt_core.evaluation.statistics import normalized_auc, success_statistics
    from metagcttt_core.meta.config import MetaConfig
    from metagcttt_core.meta.post_train import post_train
    from metagcttt_core.retrieval import FilterConfig, FilterSettings, SupportSet, TrajectoryFilter
    from metagcttt_core.training.checkpoint import (
        CheckpointError,
        load_checkpoint,
        save_checkpoint,
    )
else:
    __getattr__ = exports(
        __name__,
        {
            'adaptation.adapt': ('adapt',),
            'adaptation.config': ('TTTConfig',),
            'adaptation.result': ('Adaptation',),
            'agents.agent': ('Agent',),
            'agents.registry': ('make_agent',),
            'data.dataset': ('TrajectoryDataset',),
            'data.errors': ('DatasetError',),
            'evaluation.rollout': ('evaluate_success',),
            'evaluation.statistics': ('normalized_auc', 'success_statistics'),
            'meta.config': ('MetaConfig',),
            'meta.post_train': ('post_train',),
            'retrieval': ('FilterConfig', 'FilterSettings', 'SupportSet', 'TrajectoryFilter'),
            'training.checkpoint': ('CheckpointError', 'load_checkpoint', 'save_checkpoint'),
        },
    )

__all__ = [
    'Adaptation',
    'Agent',
    'CheckpointError',
    'DatasetError',
    'FilterConfig',
    'FilterSettings',
    'MetaConfig',
    'SupportSet',
    'TTTConfig',
    'TrajectoryDataset',
    'TrajectoryFilter',
    'adapt',
    'evaluate_success',
    'load_checkpoint',
    'make_agent',
    'normalized_auc',
    'post_train',
    'save_checkpoint',
    'success_statistics',
]
