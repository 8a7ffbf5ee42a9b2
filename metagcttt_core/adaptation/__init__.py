"""Adaptation: from base weights to expert weights."""

from typing import TYPE_CHECKING

from metagcttt_core.lazy import exports

if TYPE_CHECKING:
    from metagcttt_core.adaptation.config import TTTConfig, TTTSettings
    from metagcttt_core.adaptation.result import Adaptation, AdaptationCancelled, OnStep
else:
    __getattr__ = exports(
        __name__,
        {
            'config': ('TTTConfig', 'TTTSettings'),
            'result': ('Adaptation', 'AdaptationCancelled', 'OnStep'),
        },
    )

__all__ = ['Adaptation', 'AdaptationCancelled', 'OnStep', 'TTTConfig', 'TTTSettings']
