"""Adaptation: from base weights to expert weights."""

from metagcttt_core.adaptation.adapt import adapt
from metagcttt_core.adaptation.config import TTTConfig
from metagcttt_core.adaptation.result import Adaptation, AdaptationCancelled, OnStep

__all__ = ['Adaptation', 'AdaptationCancelled', 'OnStep', 'TTTConfig', 'adapt']
