"""Meta-GC-TTT: offline goal-conditioned policies that adapt at test time."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from metagcttt_core.adaptation import adapt, Adaptation, TTTConfig
    from metagcttt_core.agents import Agent, make_agent
    from metagcttt_core.data import DatasetError, TrajectoryDataset
    from metagcttt_core.evaluation import evaluate_success, normalized_auc, success_statistics
    from metagcttt_core.meta import MetaConfig, post_train
    from metagcttt_core.retrieval import FilterConfig, SupportSet, TrajectoryFilter
    from metagcttt_core.training.checkpoint import (
        CheckpointError,
        load_checkpoint,
        save_checkpoint,
    )

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

# A name is imported when it is first asked for: PyTorch takes a second or more, and the dataset
# and the filter do without it.
_NAMES = {
    'adaptation': ('Adaptation', 'TTTConfig', 'adapt'),
    'agents': ('Agent', 'make_agent'),
    'data': ('DatasetError', 'TrajectoryDataset'),
    'evaluation': ('evaluate_success', 'normalized_auc', 'success_statistics'),
    'meta': ('MetaConfig', 'post_train'),
    'retrieval': ('FilterConfig', 'SupportSet', 'TrajectoryFilter'),
    'training.checkpoint': ('CheckpointError', 'load_checkpoint', 'save_checkpoint'),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

if not TYPE_CHECKING:  # which knows the names from above

    def __getattr__(name: str) -> object:
        """The public object of that name."""
        if name not in _MODULES:
            raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
        value = getattr(import_module(f'{__name__}.{_MODULES[name]}'), name)
        globals()[name] = value
        return value
