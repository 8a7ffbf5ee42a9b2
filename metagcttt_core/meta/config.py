"""Settings of meta-post-training."""

from typing import Literal

from pydantic import Field

from metagcttt_core.adaptation.config import InnerLoopConfig
from metagcttt_core.retrieval.config import FilterConfig

Algorithm = Literal['continual', 'fomaml', 'reptile', 'maml']


class MetaConfig(InnerLoopConfig):
    """Algorithm 1 and its hyperparameters (paper, section 4 and appendix F)."""

    algorithm: Algorithm = Field('continual', description='meta-update rule')
    outer_steps: int = Field(50_000, ge=1, description='outer steps N')
    inner_steps: int = Field(100, ge=1, description='inner steps K, the most with early stopping')
    inner_lr: float = Field(3e-5, gt=0, description='inner learning rate alpha')
    meta_lr: float = Field(
        3e-4,
        gt=0,
        description='beta: rate of the outer Adam (fomaml, maml), merging coefficient (reptile)',
    )
    meta_batch_size: int = Field(1, ge=1, description='tasks per outer step B')
    filter: FilterConfig = FilterConfig()
