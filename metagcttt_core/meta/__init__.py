"""Meta-post-training: the outer loop and its meta-updates."""

from typing import TYPE_CHECKING

from metagcttt_core.lazy import exports

if TYPE_CHECKING:
    from metagcttt_core.meta.config import MetaConfig
    from metagcttt_core.meta.health import DivergedError
    from metagcttt_core.meta.report import OuterStep, TaskReport
    from metagcttt_core.meta.tasks import TaskError
else:
    __getattr__ = exports(
        __name__,
        {
            'config': ('MetaConfig',),
            'health': ('DivergedError',),
            'report': ('OuterStep', 'TaskReport'),
            'tasks': ('TaskError',),
        },
    )

__all__ = ['DivergedError', 'MetaConfig', 'OuterStep', 'TaskError', 'TaskReport']
