"""An agent from another package: cloning by the Huber loss, which forgives outlying actions.

Try it: pip install ./examples/custom_agent && metagcttt pretrain --agent huber --huber.delta 0.1
"""

from typing import ClassVar

from metagcttt_core.agents import Agent, TensorBatch
from metagcttt_core.agents.config import AgentSettings, GCBCSettings
from pydantic import Field
from torch import Tensor
from torch.nn.functional import huber_loss


class HuberSettings(GCBCSettings):
    """Goals as for GCBC, and a setting of its own, which becomes `--huber.delta`."""

    delta: float = Field(0.2, gt=0, description='error from which on the loss grows linearly')


class HuberAgent(Agent):
    """Clones the dataset's actions towards goals reached later."""

    name: ClassVar[str] = 'huber'
    settings_type: ClassVar[type[AgentSettings]] = HuberSettings
    settings: HuberSettings

    def losses(
        self, batch: TensorBatch, *, actor_only: bool = False
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean Huber loss of the policy's mean action."""
        _, mean = self.log_prob(batch['observations'], batch['actor_goals'], batch['actions'])
        loss = huber_loss(mean, batch['actions'], delta=self.settings.delta)
        return loss, {'huber': loss.detach()}
