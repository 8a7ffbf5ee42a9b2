"""Adaptation: from base weights to expert weights."""

from metagcttt_core.adaptation.adapt import adapt, Adaptation
from metagcttt_core.adaptation.config import TTTConfig
from metagcttt_core.adaptation.inner_loop import AdaptationCancelled

__all__ = ['Adaptation', 'AdaptationCancelled', 'TTTConfig', 'adapt']
