"""Settings of the inner loop, at test time and in meta-post-training."""

from typing import Literal, Self

from pydantic import Field, model_validator

from metagcttt_core.config.settings import Settings
from metagcttt_core.training.config import EngineName, OptimizerName, Precision

GuardName = Literal['none', 'loss', 'imitation']


class InnerLoopConfig(Settings):
    """Settings shared by test-time training and the inner loop of post-training."""

    batch_size: int = Field(1024, ge=1, description='transitions per inner step')
    optimizer: OptimizerName = Field('adam', description='inner optimiser')
    early_stopping: bool = Field(True, description='use the inner step of lowest held-out loss')
    test_fraction: float = Field(0.2, gt=0, lt=1, description='share of the support held out')
    max_test: int = Field(128, ge=1, description='most transitions in the test split')
    actor_only: bool = Field(False, description='update the actor and leave the critic')
    fix_actor_goal: float = Field(
        1.0, ge=0, le=1, description="probability that an actor goal is the query's goal"
    )
    engine: EngineName = Field(
        'auto', description='what computes the steps; the fastest that agent and machine have'
    )
    precision: Precision = Field(
        'float32', description='of matrix products; weights and optimiser stay float32'
    )
    ratio: float = Field(
        1.0, ge=0, le=1, description='share of a batch from the support, the rest from all data'
    )


class TTTLoopConfig(InnerLoopConfig):
    """The inner loop at test time, without K and the learning rate."""

    optimizer_state: Literal['fresh', 'pretrained'] = Field(
        'fresh', description='Adam moments and step count to begin with'
    )
    early_stopping: bool = Field(False, description='hold out a test split and keep the best step')
    guard: GuardName = Field(
        'none',
        description='hold out a test split and act with the base policy unless the loss on it, or '
        'the negative log-likelihood of its actions (imitation), fell',
    )

    @model_validator(mode='after')
    def _state_is_of_adam(self) -> Self:
        if self.optimizer_state == 'pretrained' and self.optimizer != 'adam':
            raise ValueError(
                'optimizer_state=pretrained is the state of Adam, by which policies are '
                f'pre-trained, but optimizer is {self.optimizer}'
            )
        return self


class TTTSettings(TTTLoopConfig):
    """Test-time training but for its budget K, for programs that run through budgets."""

    lr: float = Field(3e-4, gt=0, description='inner learning rate alpha')
    horizon: int | None = Field(
        None, ge=1, description='environment steps after which to adapt again; never by default'
    )

    def with_steps(self, steps: int) -> 'TTTConfig':
        """The settings with a budget of K gradient steps."""
        return TTTConfig(**{**self.model_dump(), 'steps': steps})


class TTTConfig(TTTSettings):
    """K gradient steps on the support set of a query (paper, section 3.2)."""

    steps: int = Field(10, ge=0, description='gradient steps K; 0 acts with the base policy')
