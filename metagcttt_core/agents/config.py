"""Settings of the agents."""

from typing import Literal, Self, TYPE_CHECKING

from pydantic import Field, model_validator, PositiveInt

from metagcttt_core.agents.registry import AGENTS
from metagcttt_core.config.settings import Settings
from metagcttt_core.data.relabel import GoalConfig, GoalDistribution

if TYPE_CHECKING:
    AgentName = str
else:
    AgentName = AGENTS.names
ActorLoss = Literal['ddpgbc', 'awr', 'bc']


class AgentOptions(Settings):
    """Settings that all agents share, other than the size of their networks."""

    const_std: bool = Field(
        True, description='unit standard deviation of the actor (else learned)'
    )
    discount: float = Field(0.99, gt=0, lt=1, description='of values and of geometric goals')
    goals: GoalConfig = GoalConfig()


class AgentSettings(AgentOptions):
    """All settings of an agent."""

    hidden: tuple[PositiveInt, ...] = Field(
        (512, 512, 512), min_length=1, max_length=64, description='units of each hidden layer'
    )


class GCBCOptions(AgentOptions):
    """Options of GCBC: actor goals are later states of the trajectory; no value goals."""

    goals: GoalConfig = GoalConfig(value=None)

    @model_validator(mode='after')
    def _goals_are_the_actor_s(self) -> Self:
        if self.goals != GoalConfig(value=None, actor=self.goals.actor):
            raise ValueError('goals.value and goals.gc_negative have no effect on GCBC')
        return self


class ExtractionOptions(AgentOptions):
    """Options of agents that extract their actor from a critic."""

    actor_loss: ActorLoss = Field('ddpgbc', description='policy extraction')
    alpha: float = Field(
        0.3, ge=0, description='ddpgbc: weight of cloning; awr: inverse temperature of advantages'
    )


class GCIQLOptions(ExtractionOptions):
    """Options of GCIQL."""

    expectile: float = Field(0.9, gt=0, lt=1, description='of the value regression')
    tau: float = Field(0.005, gt=0, le=1, description='rate of the target critics')


class SAWOptions(AgentOptions):
    """Options of SAW; the defaults are those of the authors' code (impls/agents/saw.py)."""

    expectile: float = Field(0.7, gt=0, lt=1, description='of the value regression')
    tau: float = Field(0.005, gt=0, le=1, description='rate of the target values')
    subgoal_steps: int = Field(25, ge=1, description='most steps to a waypoint')
    alpha: float = Field(3.0, ge=0, description='inverse temperature of the advantages of actions')
    subpolicy_alpha: float = Field(3.0, ge=0, description='the same, for the sub-policy')
    waypoint_alpha: float = Field(
        3.0, ge=0, description='inverse temperature of the advantages of waypoints'
    )
    rep_dim: int = Field(10, ge=1, description='width of the goal representations')


class CRLOptions(ExtractionOptions):
    """Options of CRL; the defaults are those of OGBench's code (impls/agents/crl.py)."""

    goals: GoalConfig = GoalConfig(value=GoalDistribution(geometric=True))
    alpha: float = Field(
        0.1, ge=0, description='ddpgbc: weight of cloning; awr: inverse temperature of advantages'
    )
    latent_dim: int = Field(512, ge=1, description='width of the representations phi and psi')

    @model_validator(mode='after')
    def _goals_have_no_rewards(self) -> Self:
        if self.goals.value is None or not self.goals.gc_negative:
            raise ValueError('CRL needs goals.value, and goals.gc_negative has no effect on it')
        return self


class GCBCSettings(GCBCOptions, AgentSettings):
    """All settings of GCBC."""


class GCIQLSettings(GCIQLOptions, AgentSettings):
    """All settings of GCIQL."""


class CRLSettings(CRLOptions, AgentSettings):
    """All settings of CRL."""


class SAWSettings(SAWOptions, AgentSettings):
    """All settings of SAW."""
