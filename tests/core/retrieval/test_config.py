"""FilterConfig: defaults of the paper and refusals."""

from metagcttt_core import FilterConfig
from pydantic import ValidationError
import pytest


def test_defaults_are_those_of_the_paper():
    config = FilterConfig()
    assert config.variant == 'paper'
    assert (config.epsilon, config.top_percent, config.top_k) == (1.0, 20.0, None)
    assert (config.position_dims, config.scale) == ((0, 1), None)
    assert (config.slack, config.min_steps) == (5, 10)


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'variant': 'papr'}, "variant\n.*did you mean 'paper'.*relevance_only"),
        ({'epsilon': 0}, 'epsilon\n.*greater than 0'),
        ({'epsilon': float('inf')}, 'epsilon\n.*finite number'),
        ({'top_percent': 0}, 'top_percent\n.*greater than 0'),
        ({'top_percent': 101}, 'top_percent\n.*less than or equal to 100'),
        ({'top_k': 0}, 'top_k\n.*greater than or equal to 1'),
        ({'position_dims': ()}, 'position_dims\n.*at least 1'),
        ({'position_dims': (0, -1)}, r'position_dims must not be negative, got \(0, -1\)'),
        ({'position_dims': (1, 1)}, r'position_dims must be distinct, got \(1, 1\)'),
        ({'scale': (1.0,)}, r'one factor per position dimension \(2\), got 1'),
        ({'scale': (1.0, 0.0)}, r'scale factors must be above 0, got \(1.0, 0.0\)'),
        ({'slack': -1}, 'slack\n.*greater than or equal to 0'),
        ({'min_steps': -1}, 'min_steps\n.*greater than or equal to 0'),
        ({'epsilom': 1.0}, "no setting 'epsilom'; did you mean 'epsilon'"),
    ],
)
def test_wrong_setting_is_refused_by_name(settings, message):
    with pytest.raises(ValidationError, match=message):
        FilterConfig(**settings)
