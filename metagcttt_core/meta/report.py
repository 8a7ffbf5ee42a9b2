"""Reports of outer steps: numbers only, so that keeping them is cheap."""

from dataclasses import dataclass
from typing import Self

from metagcttt_core.adaptation.result import Adaptation
from metagcttt_core.meta.tasks import MetaTask


@dataclass(frozen=True)
class TaskReport:
    """One task and its inner loop.

    Attributes:
        goal: (obs_dim,) the goal g.
        num_transitions: Size of the filtered dataset.
        mean_steps: Mean length of the kept sub-trajectories, in transitions.
        redraws: State-goal pairs discarded before this one because the filter found too little.
        filter_ms: Time of the filter's query.
        train_losses: (K,) loss of each step's batch before the step.
        test_losses: (K + 1,) loss of the test split after 0..K steps; empty without early
            stopping.
        best_step: k*, the step whose weights the meta-update gets.
        initial_loss: Test loss of the pre-trained policy theta_0, not adapted.
        expert_loss: Test loss of the adapted policy.
    """

    goal: tuple[float, ...]
    num_transitions: int
    mean_steps: float
    redraws: int
    filter_ms: float
    train_losses: list[float]
    test_losses: list[float]
    best_step: int
    initial_loss: float
    expert_loss: float

    @classmethod
    def of(
        cls, task: MetaTask, result: Adaptation, initial_loss: float, expert_loss: float
    ) -> Self:
        """The report of a task with the outcome of its inner loop."""
        return cls(
            goal=tuple(task.goal.tolist()),
            num_transitions=task.num_transitions,
            mean_steps=task.mean_steps,
            redraws=task.redraws,
            filter_ms=task.train.milliseconds,
            train_losses=result.train_losses,
            test_losses=result.test_losses,
            best_step=result.best_step,
            initial_loss=initial_loss,
            expert_loss=expert_loss,
        )


@dataclass(frozen=True)
class OuterStep:
    """One outer step.

    Attributes:
        step: Outer steps done.
        tasks: The meta-batch, of all processes.
    """

    step: int
    tasks: list[TaskReport]
