"""TTTConfig: defaults of the paper and refusals."""

from metagcttt_core import TTTConfig
from pydantic import ValidationError
import pytest


def test_defaults_are_those_of_the_paper():
    config = TTTConfig()
    assert (config.batch_size, config.optimizer, config.optimizer_state) == (1024, 'adam', 'fresh')
    assert (config.early_stopping, config.test_fraction, config.max_test) == (False, 0.2, 128)
    assert (config.actor_only, config.fix_actor_goal, config.ratio) == (False, 1.0, 1.0)
    assert config.horizon is None


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'steps': -1}, 'steps\n.*greater than or equal to 0'),
        ({'steps': 1.5}, 'steps\n.*valid integer'),
        ({'lr': 0}, 'lr\n.*greater than 0'),
        ({'lr': float('nan')}, 'lr\n.*finite number'),
        ({'batch_size': 0}, 'batch_size\n.*greater than or equal to 1'),
        ({'optimizer': 'adamw'}, "optimizer\n.*'adam' or 'sgd'"),
        ({'optimizer_state': 'old'}, "optimizer_state\n.*'fresh' or 'pretrained'"),
        ({'test_fraction': 0}, 'test_fraction\n.*greater than 0'),
        ({'test_fraction': 1}, 'test_fraction\n.*less than 1'),
        ({'max_test': 0}, 'max_test\n.*greater than or equal to 1'),
        ({'fix_actor_goal': 1.1}, 'fix_actor_goal\n.*less than or equal to 1'),
        ({'ratio': -0.1}, 'ratio\n.*greater than or equal to 0'),
        ({'horizon': 0}, 'horizon\n.*greater than or equal to 1'),
        (
            {'optimizer': 'sgd', 'optimizer_state': 'pretrained'},
            'optimizer_state=pretrained is the state of Adam.*optimizer is sgd',
        ),
        ({'step': 3}, "no setting 'step'; did you mean 'steps'"),
    ],
)
def test_wrong_setting_is_refused_by_name(settings, message):
    with pytest.raises(ValidationError, match=message):
        TTTConfig(**settings)
