"""An agent's loss as a function of its weights."""

from torch import nn, Tensor

from metagcttt_core.agents.agent import Agent, TensorBatch


class AgentLoss(nn.Module):
    """The loss as a module's forward pass, which `torch.func.functional_call` can give weights."""

    def __init__(self, agent: Agent, actor_only: bool) -> None:
        """The loss of `agent`; its weights are named as the agent's, after `agent.`."""
        super().__init__()
        self.agent = agent
        self._actor_only = actor_only

    def forward(self, batch: TensorBatch) -> Tensor:
        """The scalar training loss of a batch."""
        return self.agent.losses(batch, actor_only=self._actor_only)[0]
