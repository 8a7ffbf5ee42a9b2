"""Meta-GC-TTT: offline goal-conditioned policies that adapt at test time."""

from metagcttt_core.adaptation import adapt, Adaptation, TTTConfig
from metagcttt_core.agents import Agent, make_agent
from metagcttt_core.data import DatasetError, TrajectoryDataset
from metagcttt_core.evaluation import evaluate_success, normalized_auc, success_statistics
from metagcttt_core.meta import MetaConfig, post_train
from metagcttt_core.retrieval import FilterConfig, SupportSet, TrajectoryFilter
from metagcttt_core.training.checkpoint import CheckpointError, load_checkpoint, save_checkpoint

__all__ = [
    'Adaptation',
    'Agent',
    'CheckpointError',
    'DatasetError',
    'FilterConfig',
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
