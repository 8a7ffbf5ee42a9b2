"""Settings of soft actor-critic."""

from typing import Literal

from metagcttt_core.config import Settings
from pydantic import Field


class SACConfig(Settings):
    """Settings of the learner; the defaults learn to walk the ant."""

    lr: float = Field(3e-4, gt=0, description='learning rate of Adam')
    critic_lr: float | None = Field(None, gt=0, description='of the critics, if it is another')
    batch_size: int = Field(256, ge=1, description='transitions per update')
    discount: float = Field(0.99, gt=0, lt=1, description='discount per control step')
    tau: float = Field(0.005, gt=0, le=1, description='averaging of the target critics')
    target_entropy: float = Field(-0.5, description='per action dimension, nats')
    temperature: float = Field(0.02, gt=0, description='weight of the entropy at the start')
    actor_hidden: tuple[int, ...] = Field((256, 256), description='units of the actor')
    critic_hidden: tuple[int, ...] = Field((256, 256), description='units of each critic')
    actor_layer_norm: bool = Field(False, description='layer norm in the actor')
    critic_layer_norm: bool = Field(False, description='layer norm in the critics')
    critics: Literal['min', 'mean'] = Field('min', description='how the two critics are combined')
    actor_critics: Literal['both', 'first'] = Field('both', description='what the actor follows')
    actor_every: int = Field(1, ge=1, description='updates of the critics per update of the actor')
    log_std_range: tuple[float, float] = Field((-5.0, 2.0), description='before the tanh')
