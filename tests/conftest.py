"""Settings that all tests share."""

import os

from hypothesis import HealthCheck, settings
import torch

# Results do not depend on how many workers share the machine.
torch.set_num_threads(1)

# How long an example takes says more about the other load than about the test.
_UNTIMED = {'deadline': None, 'suppress_health_check': [HealthCheck.too_slow]}
settings.register_profile('default', derandomize=True, max_examples=100, **_UNTIMED)
settings.register_profile('thorough', database=None, max_examples=2000, **_UNTIMED)
settings.load_profile(os.environ.get('HYPOTHESIS_PROFILE', 'default'))
