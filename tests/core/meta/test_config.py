"""MetaConfig: the paper's defaults and refusals."""

from metagcttt_core import MetaConfig
from pydantic import ValidationError
import pytest


def test_defaults_are_those_of_the_paper():
    config = MetaConfig()
    assert (config.outer_steps, config.meta_batch_size) == (50_000, 1)
    assert (config.batch_size, config.inner_steps) == (1024, 100)
    assert (config.early_stopping, config.test_fraction, config.max_test) == (True, 0.2, 128)
    assert (config.fix_actor_goal, config.ratio, config.actor_only) == (1.0, 1.0, False)
    assert config.filter.variant == 'paper'


@pytest.mark.parametrize(
    ('algorithm', 'given', 'rate'),
    [
        ('continual', None, 1.0),
        ('fomaml', None, 3e-4),
        ('maml', None, 3e-4),
        ('reptile', None, 0.1),
        ('fomaml', 0.01, 0.01),
        ('maml', 1e-5, 1e-5),
        ('reptile', 1.0, 1.0),
    ],
)
def test_outer_rate_is_by_default_that_of_the_algorithm(algorithm, given, rate):
    assert MetaConfig(algorithm=algorithm, meta_lr=given).outer_lr == rate


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'algorithm': 'mamml'}, 'algorithm\n.*unknown meta-update.*known: continual, fomaml'),
        ({'outer_steps': 0}, 'outer_steps\n.*greater than or equal to 1'),
        ({'inner_steps': 0}, 'inner_steps\n.*greater than or equal to 1'),
        ({'inner_lr': -1e-3}, 'inner_lr\n.*greater than 0'),
        ({'meta_lr': 0}, 'meta_lr\n.*greater than 0'),
        ({'meta_lr': 3e-4}, 'meta_lr has no effect on continual.*leave it out, got 0.0003'),
        (
            {'algorithm': 'fomaml', 'meta_lr': 0.1},
            'learning rate of the outer Adam of fomaml and must be at most 0.01, got 0.1',
        ),
        ({'algorithm': 'maml', 'meta_lr': 0.011}, 'of maml and must be at most 0.01, got 0.011'),
        (
            {'algorithm': 'reptile', 'meta_lr': 1.5},
            'merging coefficient of reptile and must be at most 1, got 1.5',
        ),
        ({'meta_batch_size': 0}, 'meta_batch_size\n.*greater than or equal to 1'),
        ({'test_fraction': 1.0}, 'test_fraction\n.*less than 1'),
        ({'filter': {'epsilon': -1}}, 'filter.epsilon\n.*greater than 0'),
        ({'outer_step': 3}, "no setting 'outer_step'; did you mean 'outer_steps'"),
    ],
)
def test_wrong_setting_is_refused_by_name(settings, message):
    with pytest.raises(ValidationError, match=message):
        MetaConfig(**settings)
