"""Settings of the inner loop, at test time and in meta-post-training."""

from typing import Literal

from pydantic import Field

from metagcttt_core.config.settings import Settings
from metagcttt_core.training.config import OptimizerName


class InnerLoopConfig(Settings):
    """What test-time training and the inner loop of post-training have in common."""

    batch_size: int = Field(1024, ge=1, description='transitions per inner step')
    optimizer: OptimizerName = Field('adam', description='inner optimiser')
    early_stopping: bool = Field(True, description='use the inner step of lowest held-out loss')
    test_fraction: float = Field(0.2, gt=0, lt=1, description='share of the support held out')
    max_test: int = Field(128, ge=1, description='most transitions in the test split')
    actor_only: bool = Field(False, description='update the actor and leave the critic')
    fix_actor_goal: float = Field(
        1.0, ge=0, le=1, description="probability that an actor goal is the query's goal"
    )
    ratio: float = Field(
        1.0, ge=0, le=1, description='share of a batch from the support, the rest from all data'
    )


class TTTConfig(InnerLoopConfig):
    """K gradient steps on the support set of a query (paper, section 3.2)."""

    steps: int = Field(10, ge=0, description='gradient steps K; 0 acts with the base policy')
    lr: float = Field(3e-4, gt=0, description='inner learning rate alpha')
    optimizer_state: Literal['fresh', 'pretrained'] = Field(
        'fresh', description='Adam moments and step count to begin with'
    )
    early_stopping: bool = Field(False, description='hold out a test split and keep the best step')
    horizon: int | None = Field(
        None, ge=1, description='environment steps after which to adapt again; never by default'
    )
