"""Plans of datasets against OGBench's sizes."""

from pydantic import ValidationError
import pytest
from sim_bridge.generation.behaviours import Kind
from sim_bridge.generation.plan import plan_dataset


@pytest.mark.parametrize(
    ('name', 'kind', 'episodes', 'rows', 'noise'),
    [
        ('pointmaze-medium-v0', 'navigate', 1000, 1001, 0.5),
        ('pointmaze-giant-v0', 'navigate', 500, 2001, 0.5),
        ('pointmaze-teleport-v0', 'stitch', 5000, 201, 0.5),
        ('antmaze-medium-v0', 'navigate', 1000, 1001, 0.2),
        ('antmaze-giant-v0', 'navigate', 500, 2001, 0.2),
        ('antmaze-giant-v0', 'stitch', 5000, 201, 0.2),
        ('antmaze-large-v0', 'explore', 10000, 501, 1.0),
        ('humanoidmaze-medium-v0', 'navigate', 1000, 2001, 0.2),
        ('humanoidmaze-giant-v0', 'navigate', 1000, 4001, 0.2),
        ('humanoidmaze-medium-v0', 'stitch', 5000, 401, 0.2),
        ('humanoidmaze-giant-v0', 'stitch', 10000, 401, 0.2),
    ],
)
def test_default_size_and_noise_are_ogbenchs(
    name: str, kind: Kind, episodes: int, rows: int, noise: float
) -> None:
    plan = plan_dataset(name, kind)
    assert (plan.episodes, plan.rows_per_episode, plan.noise) == (episodes, rows, noise)
    assert plan.validation_episodes == episodes // 10


def test_asked_numbers_replace_the_defaults_even_when_zero() -> None:
    plan = plan_dataset(
        'pointmaze-medium-v0', 'stitch', seed=3, episodes=4, rows_per_episode=11, noise=0.0
    )
    assert (plan.seed, plan.episodes, plan.rows_per_episode, plan.noise) == (3, 4, 11, 0.0)
    assert plan.validation_episodes == 1


def test_dataset_name_is_planned_as_its_maze() -> None:
    assert plan_dataset('pointmaze-medium-navigate-v0', 'stitch').environment == (
        'pointmaze-medium-v0'
    )


@pytest.mark.parametrize(
    'wrong', [{'episodes': 0}, {'rows_per_episode': 1}, {'noise': -0.1}, {'seed': -1}]
)
def test_number_out_of_range_is_refused_by_name(wrong: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        plan_dataset('pointmaze-medium-v0', 'navigate', **wrong)  # type: ignore[arg-type]
