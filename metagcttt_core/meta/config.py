"""Settings of meta-post-training."""

from typing import Literal

from pydantic import Field

from metagcttt_core.config.settings import Settings
from metagcttt_core.retrieval.config import FilterConfig
from metagcttt_core.training.optimizers import OptimizerName

Algorithm = Literal['continual', 'fomaml', 'reptile']


class MetaConfig(Settings):
    """Algorithm 1 and its hyperparameters (paper, section 4 and appendix F)."""

    algorithm: Algorithm = Field('continual', description='meta-update rule')
    outer_steps: int = Field(50_000, ge=1, description='outer steps N')
    inner_steps: int = Field(100, ge=1, description='inner steps K, the most with early stopping')
    inner_lr: float = Field(3e-5, gt=0, description='inner learning rate alpha')
    meta_lr: float = Field(
        3e-4,
        gt=0,
        description='beta: rate of the outer Adam (fomaml), merging coefficient (reptile)',
    )
    batch_size: int = Field(1024, ge=1, description='transitions per inner step')
    meta_batch_size: int = Field(1, ge=1, description='tasks per outer step B')
    optimizer: OptimizerName = Field('adam', description='inner optimiser, fresh for each task')
    early_stopping: bool = Field(True, description='use the inner step of lowest test loss')
    test_fraction: float = Field(0.2, gt=0, lt=1, description='share of the support held out')
    max_test: int = Field(128, ge=1, description='most transitions in the test split')
    actor_only: bool = Field(False, description='adapt and update the actor alone')
    fix_actor_goal: float = Field(
        1.0, ge=0, le=1, description="probability that an actor goal is the task's goal"
    )
    ratio: float = Field(1.0, ge=0, le=1, description='share of a batch from the support')
    filter: FilterConfig = FilterConfig()
