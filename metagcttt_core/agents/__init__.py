"""Goal-conditioned agents; adding one is a module and a line in `registry.py`."""

from typing import TYPE_CHECKING

from metagcttt_core.lazy import exports

if TYPE_CHECKING:
    from metagcttt_core.agents.agent import Agent, TensorBatch
    from metagcttt_core.agents.config import AgentName, AgentSettings
    from metagcttt_core.agents.crl import CRL
    from metagcttt_core.agents.gcbc import GCBC
    from metagcttt_core.agents.gciql import GCIQL
    from metagcttt_core.agents.registry import AGENTS, make_agent
    from metagcttt_core.agents.saw import SAW
else:
    __getattr__ = exports(
        __name__,
        {
            'agent': ('Agent', 'TensorBatch'),
            'config': ('AgentName', 'AgentSettings'),
            'crl': ('CRL',),
            'gcbc': ('GCBC',),
            'gciql': ('GCIQL',),
            'registry': ('AGENTS', 'make_agent'),
            'saw': ('SAW',),
        },
    )

__all__ = [
    'AGENTS',
    'CRL',
    'GCBC',
    'GCIQL',
    'SAW',
    'Agent',
    'AgentName',
    'AgentSettings',
    'TensorBatch',
    'make_agent',
]
