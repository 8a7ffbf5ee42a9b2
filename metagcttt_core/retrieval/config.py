"""Settings of the trajectory filter."""

from collections.abc import Mapping
from typing import Any, Self, TYPE_CHECKING

from pydantic import Field, model_validator, ValidationError

from metagcttt_core.config.settings import error_lines, Settings
from metagcttt_core.retrieval.registry import VARIANTS

if TYPE_CHECKING:
    Variant = str
else:
    Variant = VARIANTS.names


class FilterSettings(Settings):
    """`FilterConfig` whose distances, left out, are those of the robot's contract."""

    variant: Variant = Field('paper', description='selection rule')
    epsilon: float | None = Field(
        None,
        gt=0,
        description="locality radius, in units of the position; by default the contract's, or 1",
    )
    top_percent: float = Field(
        20.0, gt=0, le=100, description='percent of scored trajectories kept'
    )
    top_k: int | None = Field(None, ge=1, description='number kept, instead of top_percent')
    position_dims: tuple[int, ...] | None = Field(
        None,
        min_length=1,
        description="observation coordinates that distances use; by default the contract's, or "
        '0 and 1',
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
        dims, scale = self.position_dims, self.scale
        if dims is not None and any(dim < 0 for dim in dims):
            raise ValueError(f'position_dims must not be negative, got {dims}')
        if dims is not None and len(set(dims)) < len(dims):
            raise ValueError(f'position_dims must be distinct, got {dims}')
        if dims is not None and scale is not None and len(scale) != len(dims):
            raise ValueError(
                f'scale must have one factor per position dimension ({len(dims)}), '
                f'got {len(scale)}'
            )
        if scale is not None and any(factor <= 0 for factor in scale):
            raise ValueError(f'scale factors must be above 0, got {scale}')
        return self

    def on(self, contract: Mapping[str, Any] | None) -> 'FilterConfig':
        """The settings in force on data of a contract.

        Args:
            contract: `Contract.identity`, as data and policies carry it, if they do.

        Raises:
            ValueError: If `scale` does not fit the contract's coordinates.
        """
        of_contract = {name: (contract or {}).get(name) for name in ('epsilon', 'position_dims')}
        known = {name: value for name, value in of_contract.items() if value}
        try:
            return FilterConfig(**known | self.model_dump(exclude_none=True))
        except ValidationError as error:
            raise ValueError('; '.join(error_lines(error))) from error


class FilterConfig(FilterSettings):
    """Settings of `TrajectoryFilter`: how it selects sub-trajectories.

    Variants: `paper` (appendix A); `gcttt`, the published implementation of GC-TTT; and three
    ablations: `random` trajectories, `relevance_only` (near the state, whatever the goal) and
    `score_only` (good for the goal, wherever the state).
    """

    epsilon: float = Field(1.0, gt=0, description='locality radius, in units of the position')
    position_dims: tuple[int, ...] = Field(
        (0, 1), min_length=1, description='observation coordinates that distances use'
    )

    @property
    def cell_size(self) -> float:
        """Edge of the spatial index's cells, in scaled units: a ball is 8 of them across."""
        return self.epsilon / 4
