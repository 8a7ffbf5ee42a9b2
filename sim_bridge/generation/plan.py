"""Generation plans: the settings that determine every byte of a dataset."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from sim_bridge.generation.behaviours import Kind
from sim_bridge.registry import describe_environment

CHUNK_ROWS = 20_000
"""Rows recorded between two writes to disk, rounded down to whole episodes."""


class GenerationPlan(BaseModel):
    """Settings of one dataset; the same plan gives the same dataset.

    `plan_dataset` fills in OGBench's numbers.
    """

    model_config = ConfigDict(frozen=True, extra='forbid', allow_inf_nan=False)

    environment: str = Field(description='Name of the maze, as make_simulator takes it.')
    kind: Kind = Field(description='behaviour policy')
    episodes: int = Field(ge=1, description='Training episodes; a tenth as many validate.')
    rows_per_episode: int = Field(ge=2, description='Rows of an episode; transitions plus one.')
    noise: float = Field(ge=0, description='Standard deviation of the action noise.')
    seed: int = Field(ge=0, description='Random seed.')
    to_goal: bool = Field(False, description="Walk to the goal, not to its cell's center.")
    standing: bool = Field(
        False, description='Humanoids start on their feet and end a second before a fall.'
    )

    @property
    def validation_episodes(self) -> int:
        """A tenth of the training episodes, rounded down, but at least one."""
        return max(1, self.episodes // 10)

    @property
    def chunk_episodes(self) -> int:
        """Episodes that are written to disk together."""
        return max(1, CHUNK_ROWS // self.rows_per_episode)


def plan_dataset(
    environment: str,
    kind: Kind,
    seed: int = 0,
    episodes: int | None = None,
    rows_per_episode: int | None = None,
    noise: float | None = None,
    to_goal: bool = False,
    standing: bool = False,
) -> GenerationPlan:
    """Plan a dataset, with OGBench's size and noise by default.

    Mazes of gymnasium-robotics, for which OGBench has no data, get those of its point maze.

    Raises:
        ValueError: If the environment is unknown, or has no humanoid that could start standing.
        pydantic.ValidationError: If a number is out of range.

    Example:
        >>> plan = plan_dataset('pointmaze-medium-v0', 'stitch')
        >>> plan.episodes, plan.rows_per_episode, plan.noise
        (5000, 201, 0.5)
    """
    name = describe_environment(environment).spec.name
    if standing and not name.startswith('humanoidmaze'):
        raise ValueError(f'{name}: only humanoids have a standing start')
    usual = _ogbench_size(name if '_' not in name else 'pointmaze-medium-v0', kind)
    asked = {'episodes': episodes, 'rows_per_episode': rows_per_episode, 'noise': noise}
    given = {key: value for key, value in asked.items() if value is not None}
    return GenerationPlan(
        environment=name,
        kind=kind,
        seed=seed,
        to_goal=to_goal,
        standing=standing,
        **{**usual, **given},
    )


def _ogbench_size(name: str, kind: Kind) -> dict[str, Any]:
    """Episodes, rows and noise of OGBench's dataset of this maze and kind.

    Source: OGBench, `data_gen_scripts/commands.sh`. It has no explore data for the point and the
    humanoid, which get the ant's.
    """
    robot, layout, _ = name.split('-')
    humanoid = robot == 'humanoidmaze'
    giant = layout == 'giant'
    if kind == 'explore':
        return {'episodes': 10_000, 'rows_per_episode': 501, 'noise': 1.0}
    noise = 0.5 if robot == 'pointmaze' else 0.2
    if kind == 'stitch':
        episodes = 10_000 if humanoid and giant else 5000
        return {'episodes': episodes, 'rows_per_episode': 401 if humanoid else 201, 'noise': noise}
    rows = (2001 if humanoid else 1001) if not giant else (4001 if humanoid else 2001)
    episodes = 500 if giant and not humanoid else 1000
    return {'episodes': episodes, 'rows_per_episode': rows, 'noise': noise}
