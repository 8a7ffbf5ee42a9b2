"""Goal-conditioned behavioural cloning (paper, equation 2)."""

from typing import ClassVar, TYPE_CHECKING

import torch
from torch import Tensor

from metagcttt_core.agents.agent import Agent, TensorBatch
from metagcttt_core.agents.config import AgentSettings, GCBCSettings

if TYPE_CHECKING:
    from metagcttt_core.agents.analytic import AnalyticLoss
    from metagcttt_core.kernels import Kernels


class GCBC(Agent):
    """Maximises the likelihood of the dataset's actions towards goals reached later."""

    name: ClassVar[str] = 'gcbc'
    settings_type: ClassVar[type[AgentSettings]] = GCBCSettings

    def losses(
        self, batch: TensorBatch, *, actor_only: bool = False
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Negative mean log-likelihood (`bc`); `mse` is the mean's squared error."""
        log_prob, mean = self.log_prob(
            batch['observations'], batch['actor_goals'], batch['actions']
        )
        bc_loss = -log_prob.mean()
        mse = (mean.detach() - batch['actions']).square().mean()
        return bc_loss, {'bc': bc_loss.detach(), 'mse': mse}

    def analytic_loss(
        self,
        *,
        actor_only: bool = False,
        dtype: torch.dtype = torch.float32,
        kernels: 'Kernels | None' = None,
    ) -> 'AnalyticLoss | None':
        """See `Agent.analytic_loss`; on a processor, with unit standard deviation."""
        from metagcttt_core.agents.analytic import Cloning

        if not self._has_analytic_loss_of(GCBC):
            return None
        return Cloning(self, dtype, kernels)
