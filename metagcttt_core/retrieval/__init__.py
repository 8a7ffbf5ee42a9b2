"""Retrieval: from a dataset, a state and a goal to a support set."""

from metagcttt_core.retrieval.config import FilterConfig, FilterSettings
from metagcttt_core.retrieval.support import SupportSet
from metagcttt_core.retrieval.trajectory_filter import TrajectoryFilter

__all__ = ['FilterConfig', 'FilterSettings', 'SupportSet', 'TrajectoryFilter']
