"""Goal relabelling: batches whose goals are states of the dataset (OGBench's distributions)."""

from typing import Self

import numpy as np
from pydantic import Field, model_validator

from metagcttt_core.config.settings import Settings
from metagcttt_core.data.dataset import TrajectoryDataset
from metagcttt_core.data.scaling import Scaling

Batch = dict[str, np.ndarray]


class GoalDistribution(Settings):
    """Distribution of the goal of a transition; the three probabilities sum to 1."""

    p_curgoal: float = Field(0.0, ge=0, le=1, description='probability of the current state')
    p_trajgoal: float = Field(
        1.0, ge=0, le=1, description='probability of a later state of the trajectory'
    )
    p_randomgoal: float = Field(
        0.0, ge=0, le=1, description='probability of a random state of the dataset'
    )
    geometric: bool = Field(False, description='later states geometrically near (else uniform)')

    @model_validator(mode='after')
    def _sum_to_one(self) -> Self:
        total = self.p_curgoal + self.p_trajgoal + self.p_randomgoal
        if abs(total - 1) > 1e-6:
            raise ValueError(
                f'p_curgoal + p_trajgoal + p_randomgoal must sum to 1, got {total:g} '
                f'({self.p_curgoal:g} + {self.p_trajgoal:g} + {self.p_randomgoal:g})'
            )
        return self


class GoalConfig(Settings):
    """Goal distributions of value and actor, and the reward they define."""

    value: GoalDistribution | None = Field(
        GoalDistribution(p_curgoal=0.2, p_trajgoal=0.5, p_randomgoal=0.3, geometric=True),
        description='goals of value and critic; none for an agent without them',
    )
    actor: GoalDistribution = GoalDistribution()
    gc_negative: bool = Field(
        True, description='reward 0 at the goal and -1 elsewhere (else 1 and 0)'
    )


class GoalRelabeller:
    """Draws transitions and goals for them from a dataset."""

    def __init__(
        self,
        dataset: TrajectoryDataset,
        config: GoalConfig,
        discount: float = 0.99,
        *,
        subgoal_steps: int | None = None,
        scaling: Scaling | None = None,
    ) -> None:
        """Draw from `dataset` by the distributions of `config`.

        Args:
            dataset: Where transitions and goals come from.
            config: Distributions of the goals.
            discount: Shapes geometric goals: P(k) = (1 - discount) discount^(k-1).
            subgoal_steps: Steps to the waypoints in the batches; none by default.
            scaling: From the dataset's units to those of the batches; none by default.
        """
        self.dataset = dataset
        self.config = config
        self.discount = discount
        self.subgoal_steps = subgoal_steps
        self.scaling = scaling or Scaling.identity(dataset.obs_dim, dataset.act_dim)

    def sample(self, batch_size: int, rng: np.random.Generator) -> Batch:
        """A batch of uniformly drawn transitions, relabelled; see `relabel` for its keys."""
        return self.relabel(self.dataset.sample_transitions(batch_size, rng), rng)

    def relabel(self, rows: np.ndarray, rng: np.random.Generator) -> Batch:
        """The transitions at `rows` with freshly drawn goals.

        Args:
            rows: (B,) rows that have a successor.
            rng: Source of the goals; value and actor goals are independent.

        Returns:
            OGBench's batch, float32: `observations`, `next_observations`, `value_goals`,
            `actor_goals` (B, obs_dim), `actions` (B, act_dim), `rewards`, `masks` (B,). The
            reward is 0 and the mask 0 where the value goal is the row itself, else -1 and 1 (with
            `gc_negative`). Without value goals in the config, only `observations`, `actions` and
            `actor_goals`. With `subgoal_steps` also `subgoals` and `waypoints` (B, obs_dim): the
            states that many steps later, or at the end of the trajectory, and the same but no
            later than the actor goal, if that lies ahead on the trajectory.
        """
        return self.gather(rows, **self.draw_goals(rows, rng))

    def draw_goals(self, rows: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Rows of goals for the transitions at `rows` (B,): `value_rows`, `actor_rows`."""
        goals = {'value_rows': self.config.value, 'actor_rows': self.config.actor}
        return {
            name: self.goal_rows(rows, distribution, rng)
            for name, distribution in goals.items()
            if distribution is not None
        }

    def gather(
        self, rows: np.ndarray, actor_rows: np.ndarray, value_rows: np.ndarray | None = None
    ) -> Batch:
        """The batch of the transitions at `rows` with goals at the other rows.

        Args:
            rows: (..., B) rows that have a successor; the arrays of the batch get the same
                leading axes.
            actor_rows: (..., B) rows of the actor goals.
            value_rows: (..., B) rows of the value goals, if there are such.
        """
        data = self.dataset
        batch = {
            'observations': self._seen(rows),
            'actions': self.scaling.actions(data.actions[rows]),
        }
        if value_rows is not None:
            success = (value_rows == rows).astype(np.float32)
            batch['next_observations'] = self._seen(rows + 1)
            batch['value_goals'] = self._seen(value_rows)
            batch['rewards'] = success - np.float32(self.config.gc_negative)
            batch['masks'] = 1 - success
        batch['actor_goals'] = self._seen(actor_rows)
        if self.subgoal_steps is not None:
            final = data.episode_ends[data.episode_of(rows)] - 1  # as in `goal_rows`
            subgoals = np.minimum(rows + self.subgoal_steps, final)
            ahead = (rows <= actor_rows) & (actor_rows <= final)
            waypoints = np.where(ahead, np.minimum(subgoals, actor_rows), subgoals)
            batch['subgoals'] = self._seen(subgoals)
            batch['waypoints'] = self._seen(waypoints)
        return batch

    def _seen(self, rows: np.ndarray) -> np.ndarray:
        """Observations as networks see them."""
        return self.scaling.observations(self.dataset.observations[rows], self.dataset.origin)

    @staticmethod
    def fix_actor_goals(batch: Batch, fixed: np.ndarray, goal: np.ndarray) -> None:
        """Set the actor goals of the transitions where `fixed` (..., B) to `goal` (obs_dim,).

        The goal is in the units of the batch.
        Its way is not in the dataset, so their waypoints are the subgoals.
        """
        batch['actor_goals'][fixed] = goal
        if 'waypoints' in batch:
            batch['waypoints'][fixed] = batch['subgoals'][fixed]

    def goal_rows(
        self, rows: np.ndarray, goals: GoalDistribution, rng: np.random.Generator
    ) -> np.ndarray:
        """A goal row for each transition, (B,) int64.

        The last row of a trajectory has no successor and is never a goal.
        """
        size = len(rows)
        final = self.dataset.episode_ends[self.dataset.episode_of(rows)] - 1
        if goals.geometric:
            later = np.minimum(rows + rng.geometric(1 - self.discount, size), final)
        else:
            d = rng.random(size)
            later = np.rint(d * np.minimum(rows + 1, final) + (1 - d) * final).astype(np.int64)
        if goals.p_curgoal == 1:
            return rows
        # The order of the reference: a later state or a random one, then perhaps the row itself
        # instead.
        pick_later = rng.random(size) < goals.p_trajgoal / (1 - goals.p_curgoal)
        chosen = np.where(pick_later, later, self.dataset.sample_transitions(size, rng))
        return np.where(rng.random(size) < goals.p_curgoal, rows, chosen)
