"""Settings of the trajectory filter."""

from typing import Self, TYPE_CHECKING

from pydantic import Field, model_validator

from metagcttt_core.config.settings import Settings
from metagcttt_core.retrieval.registry import VARIANTS

if TYPE_CHECKING:
    Variant = str
else:
    Variant = VARIANTS.names


class FilterConfig(Settings):
    """Settings of `TrajectoryFilter`: how it selects sub-trajectories.

    Variants: `paper` (appendix A); `gcttt`, the published implementation of GC-TTT; and three
    ablations: `random` trajectories, `relevance_only` (near the state, whatever the goal) and
    `score_only` (good for the goal, wherever the state).
    """

    variant: Variant = Field('paper', description='selection rule')
    epsilon: float = Field(1.0, gt=0, description='locality radius, in units of the position')
    top_percent: float = Field(
        20.0, gt=0, le=100, description='percent of scored trajectories kept'
    )
    top_k: int | None = Field(None, ge=1, description='number kept, instead of top_percent')
    position_dims: tuple[int, ...] = Field(
        (0, 1), min_length=1, description='observation coordinates that distances use'
    )
    scale: tuple[float, ...] | None = Field(
        None, description='factor of each position coordinate in a distance; 1 by default'
    )
    slack: int = Field(
        5, ge=0, description='gcttt: steps kept beyond the goal; 10 in the published grids'
    )
    min_steps: int = Field(
        10, ge=0, description='gcttt: fewest steps to the state of highest value'
    )
    seed: int = Field(0, ge=0, description='random seed of the ablations')

    @model_validator(mode='after')
    def _check_dims(self) -> Self:
        if any(dim < 0 for dim in self.position_dims):
            raise ValueError(f'position_dims must not be negative, got {self.position_dims}')
        if len(set(self.position_dims)) < len(self.position_dims):
            raise ValueError(f'position_dims must be distinct, got {self.position_dims}')
        if self.scale is not None:
            if len(self.scale) != len(self.position_dims):
                raise ValueError(
                    f'scale must have one factor per position dimension '
                    f'({len(self.position_dims)}), got {len(self.scale)}'
                )
            if any(factor <= 0 for factor in self.scale):
                raise ValueError(f'scale factors must be above 0, got {self.scale}')
        return self

    @property
    def cell_size(self) -> float:
        """Edge of the spatial index's cells, in scaled units: a ball is 8 of them across."""
        return self.epsilon / 4
