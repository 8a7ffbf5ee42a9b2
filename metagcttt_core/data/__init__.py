"""Offline datasets and the goals drawn from them."""

from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.errors import DatasetError
from metagcttt_core.data.relabel import Batch, GoalConfig, GoalDistribution, GoalRelabeller
from metagcttt_core.data.scaling import Scaling

__all__ = [
    'Batch',
    'DatasetError',
    'GoalConfig',
    'GoalDistribution',
    'GoalRelabeller',
    'Scaling',
    'TrajectoryDataset',
]
