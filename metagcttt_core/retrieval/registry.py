"""The selection rules of the filter by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from metagcttt_core.plugins import Registry

if TYPE_CHECKING:
    from metagcttt_core.retrieval.config import FilterConfig
    from metagcttt_core.retrieval.variants import Candidates, Task

VARIANTS: Registry[Callable[[Task, FilterConfig], Candidates]] = Registry(
    'metagcttt.filters',
    'filter variant',
    {
        name: f'metagcttt_core.retrieval.variants:{name}'
        for name in ('paper', 'gcttt', 'random', 'relevance_only', 'score_only')
    },
)
