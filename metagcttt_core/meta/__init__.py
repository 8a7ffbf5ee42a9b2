"""Meta-post-training: the outer loop and its meta-updates."""

from metagcttt_core.meta.config import MetaConfig
from metagcttt_core.meta.health import DivergedError
from metagcttt_core.meta.post_train import post_train
from metagcttt_core.meta.report import OuterStep, TaskReport
from metagcttt_core.meta.tasks import TaskError

__all__ = ['DivergedError', 'MetaConfig', 'OuterStep', 'TaskError', 'TaskReport', 'post_train']
