"""Hyper-parameters of the humanoid's controllers."""

from dataclasses import dataclass
import math
from typing import Literal

from sim_bridge.controllers.humanoid_get_up import GetUpCourse
from sim_bridge.controllers.humanoid_ground import Course

from metagcttt_tools.controller.config import SACConfig

SAC_CONFIG = SACConfig(
    critic_lr=5e-4,
    tau=0.01,
    temperature=0.1,
    actor_layer_norm=True,
    critic_layer_norm=True,
    actor_critics='first',
    actor_every=2,
    log_std_range=(-4.5, 0.5),
)
RETURN_STEPS = 3
UPDATES_PER_SWEEP = 4
AVERAGE_SHARE = 0.0005
"""What an update of the actor adds to the average of its weights, which is what is deployed."""
REPLAY_SIZE = 1_000_000
WARM_UP = 5000
"""Transitions of a stage before it learns."""


@dataclass(frozen=True)
class Stage:
    """A part of the training, which begins with an empty replay buffer.

    Attributes:
        course: What the humanoids meet.
        sweeps: Control steps of all humanoids together.
        lr: Shares of the learning rates at its beginning and end; linear in between.
    """

    name: str
    course: Course | GetUpCourse
    sweeps: int
    lr: tuple[float, float]


STAGES = (
    Stage('walk', Course(floors=32, turn_rad=(0.6, math.pi), turn_steps=12_500), 18_000, (1, 1)),
    Stage(
        'robust',
        Course(floors=40, turn_rad=(2.2, 2.2), p_turning=0.85, noisy=0.5, p_push=0.004),
        12_500,
        (1, 0.15),
    ),
    Stage(
        'mazes',
        Course(floors=20, mazes=('medium', 'large') * 10, p_turning=0.85, noisy=0.5, p_push=0.004),
        15_000,
        (0.8, 0.15),
    ),
)

HumanoidTask = Literal['walk', 'get-up']
STAGES_OF: dict[HumanoidTask, tuple[Stage, ...]] = {
    'walk': STAGES,
    'get-up': (Stage('get-up', GetUpCourse(floors=48), 100_000, (1, 0.2)),),
}
