"""The meta-updates by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from metagcttt_core.plugins import Registry

if TYPE_CHECKING:
    from metagcttt_core.meta.updates import MetaUpdate

META_UPDATES: Registry[MetaUpdate] = Registry(
    'metagcttt.meta_updates',
    'meta-update',
    {
        name: f'metagcttt_core.meta.updates:{name}'
        for name in ('continual', 'fomaml', 'reptile', 'maml')
    },
)
GRADIENT_UPDATES = frozenset({'fomaml', 'maml'})
"""Updates that step through the outer Adam, with learning rate beta."""
