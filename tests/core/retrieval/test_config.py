"""FilterConfig: defaults of the paper and refusals; FilterSettings: those of a contract."""

from metagcttt_core import FilterConfig
from metagcttt_core.retrieval import FilterSettings
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


ARM = {'epsilon': 0.3, 'position_dims': [0, 1, 3]}


@pytest.mark.parametrize(
    ('given', 'contract', 'epsilon', 'dims'),
    [
        ({}, None, 1.0, (0, 1)),
        ({}, ARM, 0.3, (0, 1, 3)),
        ({'epsilon': 1.0}, ARM, 1.0, (0, 1, 3)),
        ({'position_dims': (0, 1)}, ARM, 0.3, (0, 1)),
        ({}, {'epsilon': None, 'position_dims': [1, 0]}, 1.0, (1, 0)),
        ({}, {'epsilon': None, 'position_dims': []}, 1.0, (0, 1)),
    ],
)
def test_what_is_left_out_is_that_of_the_contract(given, contract, epsilon, dims):
    settings = FilterSettings(**given, slack=3)
    config = settings.on(contract)
    assert config == FilterConfig(epsilon=epsilon, position_dims=dims, slack=3)
    assert FilterSettings(**settings.model_dump(mode='json')).on(contract) == config
    assert config.on(ARM) == config


def test_scale_must_fit_the_coordinates_of_the_contract():
    settings = FilterSettings(scale=(1.0, 2.0))
    assert settings.on(None).scale == (1.0, 2.0)
    with pytest.raises(ValueError, match=r'one factor per position dimension \(3\), got 2'):
        settings.on(ARM)
