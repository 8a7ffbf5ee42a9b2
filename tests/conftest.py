"""Settings that all tests share."""

import os
import resource

from hypothesis import HealthCheck, settings
import pytest
from sim_bridge.opengl import choose_opengl_library
import torch

# Test files import MuJoCo themselves, and it reads the choice only once.
choose_opengl_library()

# Results do not depend on how many workers share the machine.
torch.set_num_threads(1)

# How long an example takes says more about the other load than about the test.
_UNTIMED = {'deadline': None, 'suppress_health_check': [HealthCheck.too_slow]}
settings.register_profile('default', derandomize=True, max_examples=100, **_UNTIMED)
settings.register_profile('thorough', database=None, max_examples=2000, **_UNTIMED)
settings.load_profile(os.environ.get('HYPOTHESIS_PROFILE', 'default'))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests first, so that at the end no worker waits long for another."""
    items.sort(key=lambda item: item.get_closest_marker('slow') is None)


ROOM = 2 << 30


@pytest.fixture
def bounded_memory():
    """Makes a reader fail that asks for much more memory than small files can fill."""
    used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)
