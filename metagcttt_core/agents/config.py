"""Settings of the agents."""

from typing import Literal, TYPE_CHECKING

from pydantic import Field, PositiveInt

from metagcttt_core.agents.registry import AGENTS
from metagcttt_core.config.settings import Settings
from metagcttt_core.data.relabel import GoalConfig

if TYPE_CHECKING:
    AgentName = str
else:
    AgentName = AGENTS.names
ActorLoss = Literal['ddpgbc', 'awr', 'bc']


class AgentSettings(Settings):
    """Settings that all agents share."""

    hidden: tuple[PositiveInt, ...] = Field(
        (512, 512, 512), min_length=1, description='units of each hidden layer'
    )
    const_std: bool = Field(
        True, description='unit standard deviation of the actor (else learned)'
    )
    discount: float = Field(0.99, gt=0, lt=1, description='of values and of geometric goals')
    goals: GoalConfig = GoalConfig()


class GCBCSettings(AgentSettings):
    """Settings of GCBC: actor goals are later states of the trajectory; no value goals."""

    goals: GoalConfig = GoalConfig(value=None)


class GCIQLSettings(AgentSettings):
    """Settings of GCIQL."""

    actor_loss: ActorLoss = Field('ddpgbc', description='policy extraction')
    alpha: float = Field(
        0.3, ge=0, description='ddpgbc: weight of cloning; awr: inverse temperature of advantages'
    )
    expectile: float = Field(0.9, gt=0, lt=1, description='of the value regression')
    tau: float = Field(0.005, gt=0, le=1, description='rate of the target critics')
