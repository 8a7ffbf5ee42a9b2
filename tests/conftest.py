"""Settings that all tests share."""

import os

from hypothesis import settings
import torch

# Results do not depend on how many workers share the machine.
torch.set_num_threads(1)

settings.register_profile('default', deadline=None, derandomize=True, max_examples=100)
settings.register_profile('thorough', deadline=None, database=None, max_examples=5000)
settings.load_profile(os.environ.get('HYPOTHESIS_PROFILE', 'default'))
