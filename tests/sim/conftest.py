"""Simulators that several tests share; building one takes longer than using it."""

from collections.abc import Iterator

import pytest
from sim_bridge import make_simulator, Simulator


@pytest.fixture(scope='session')
def built_point() -> Iterator[Simulator]:
    with make_simulator('pointmaze-medium-v0') as simulator:
        yield simulator


@pytest.fixture
def point(built_point: Simulator) -> Simulator:
    """The point in the medium maze, in a free episode at (0, 0), whatever ran before."""
    built_point.reset_free(seed=0, start_xy=(0.0, 0.0))
    return built_point
