"""Settings of meta-post-training."""

import math
from typing import Literal, NamedTuple, Self, TYPE_CHECKING

from pydantic import Field, model_validator

from metagcttt_core.adaptation.config import InnerLoopConfig
from metagcttt_core.meta.registry import META_UPDATES
from metagcttt_core.retrieval.config import FilterSettings

if TYPE_CHECKING:
    Algorithm = str
else:
    Algorithm = META_UPDATES.names


class _MetaLR(NamedTuple):
    meaning: str
    default: float
    largest: float


_OUTER_ADAM = _MetaLR('learning rate of the outer Adam', 3e-4, 0.01)
_META_LR = {
    'fomaml': _OUTER_ADAM,
    'maml': _OUTER_ADAM,
    'reptile': _MetaLR('merging coefficient', 0.1, 1.0),  # the paper's most frequent one
}
_OF_ANOTHER_PACKAGE = _MetaLR('learning rate of the outer Adam', 3e-4, math.inf)


class MetaConfig(InnerLoopConfig):
    """Algorithm 1 and its hyperparameters (paper, section 4 and appendix F)."""

    algorithm: Algorithm = Field('continual', description='meta-update rule')
    outer_steps: int = Field(50_000, ge=1, description='outer steps N')
    inner_steps: int = Field(100, ge=1, description='inner steps K, the most with early stopping')
    inner_lr: float = Field(3e-5, gt=0, description='inner learning rate alpha')
    meta_lr: float | None = Field(
        None,
        gt=0,
        description='beta: outer learning rate (fomaml, maml; 3e-4 by default) or merging '
        'coefficient (reptile; 0.1)',
    )
    rejected: Literal['test-gradient', 'reject'] = Field(
        'test-gradient',
        description='what a task with k* = 0 gives fomaml and maml: its test gradient at theta '
        '(test-gradient), or nothing (reject)',
    )
    meta_batch_size: int = Field(1, ge=1, description='tasks per outer step B')
    task_candidates: int = Field(
        1,
        ge=1,
        description='state-goal pairs drawn per task, of which the one with the longest '
        'trajectories is taken; 1 is uniform, as in the paper',
    )
    filter: FilterSettings = FilterSettings()

    @model_validator(mode='after')
    def _meta_lr_fits_the_algorithm(self) -> Self:
        """Refuse a merging coefficient as the outer Adam's rate: it would ruin the policy."""
        if self.meta_lr is None:
            return self
        if self.algorithm == 'continual':
            raise ValueError(
                'meta_lr has no effect on continual, which takes the mean of the adapted weights; '
                f'leave it out, got {self.meta_lr:g}'
            )
        what, _, largest = _META_LR.get(self.algorithm, _OF_ANOTHER_PACKAGE)
        if self.meta_lr > largest:
            raise ValueError(
                f'meta_lr is the {what} of {self.algorithm} and must be at most {largest:g}, '
                f'got {self.meta_lr:g}'
            )
        return self

    @property
    def outer_lr(self) -> float:
        """`meta_lr`, or the algorithm's default; 1 for CONTINUAL-TTT, which merges fully."""
        if self.algorithm == 'continual':
            return 1.0
        if self.meta_lr is not None:
            return self.meta_lr
        return _META_LR.get(self.algorithm, _OF_ANOTHER_PACKAGE).default
