"""Settings of pre-training and of gradient steps."""

from typing import Literal

from pydantic import Field

from metagcttt_core.config.settings import Settings

EngineName = Literal['auto', 'kernels', 'analytic', 'eager']
OptimizerName = Literal['adam', 'sgd']
Precision = Literal['float32', 'bfloat16', 'auto']


class PretrainConfig(Settings):
    """Settings of pre-training (OGBench's defaults)."""

    steps: int = Field(400_000, ge=1, description='gradient steps')
    lr: float = Field(3e-4, gt=0, description='learning rate of Adam')
    batch_size: int = Field(1024, ge=1, description='transitions per step')
