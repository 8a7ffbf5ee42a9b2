"""The result of an inner loop."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from torch import Tensor

from metagcttt_core.agents.agent import Agent
from metagcttt_core.retrieval.support import SupportSet

OnStep = Callable[[int, Mapping[str, Tensor]], None]
"""Called after each gradient step: the number of steps done, and the losses of the step's batch
before the step (detached scalars): `total` and its parts by name."""


class AdaptationCancelled(Exception):
    """The caller asked an adaptation to stop before its end."""


@dataclass(frozen=True)
class Adaptation:
    """An expert and how it was adapted.

    Attributes:
        agent: The expert: a copy of the base agent with the weights of the best step. `adapt`
            returns the base agent itself when it was not accepted.
        train_losses: (K,) loss of each step's batch before the step.
        test_losses: (K + 1,) held-out loss after 0..K steps; empty without early stopping.
        best_step: k* (paper, equation 9): the number of gradient steps behind `agent`'s weights.
        reason: Why it was not accepted; empty if it was.
        engine: What computed the steps; empty where none were asked for.
        support: The transitions it was adapted on, with the time the filter took; None where no
            filter ran.
        seconds: Time the inner loop took.
        adapter: Name of the service that adapted it; empty for this process.
    """

    agent: Agent
    train_losses: list[float] = field(default_factory=list)
    test_losses: list[float] = field(default_factory=list)
    best_step: int = 0
    reason: str = ''
    engine: str = ''
    support: SupportSet | None = None
    seconds: float = 0.0
    adapter: str = ''

    @property
    def accepted(self) -> bool:
        """True when `agent` has adapted weights."""
        return self.best_step > 0
