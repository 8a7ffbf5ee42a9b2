"""Meta-post-training: the outer loop and its meta-updates."""

from metagcttt_core.meta.config import MetaConfig
from metagcttt_core.meta.post_train import OuterStep, post_train

__all__ = ['MetaConfig', 'OuterStep', 'post_train']
