"""Adaptation: from base weights to expert weights."""

from typing import TYPE_CHECKING

from metagcttt_core.lazy import exports

if TYPE_CHECKING:
    from metagcttt_core.adaptation.config import TTTConfig
    from metagcttt_core.adaptation.result import Adaptation, AdaptationCancelled, OnStep
else:
    __getattr__ = exports(
        __name__,
        {
            'config': ('TTTConfig',),
            'result': ('Adaptation', 'AdaptationCancelled', 'OnStep'),
        },
    )

__all__ = ['Adaptation', 'AdaptationCancelled', 'OnStep', 'TTTConfig']
