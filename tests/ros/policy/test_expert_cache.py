from metagcttt.policy.expert_cache import ExpertCache
from metagcttt_core import Adaptation, TTTConfig
import numpy as np
import pytest

CONFIG = TTTConfig(steps=3)
HERE, GOAL = np.array([0.2, 9.0, 0.4]), np.array([5.1, 9.0, 5.2])


def adaptation(accepted: bool = True) -> Adaptation:
    return Adaptation(object(), best_step=3 if accepted else 0)


@pytest.fixture
def cache() -> ExpertCache:
    return ExpertCache(2, cell_m=1.0, position_dims=(0, 2))


def test_queries_share_an_expert_within_a_cell_only(cache: ExpertCache) -> None:
    key = cache.key(HERE, GOAL, CONFIG)
    assert key == cache.key(np.array([0.9, -7.0, 0.0]), GOAL + 0.5, CONFIG)
    assert key != cache.key(HERE - 0.3, GOAL, CONFIG)
    assert key != cache.key(HERE, GOAL + 1, CONFIG)
    assert key != cache.key(HERE, GOAL, TTTConfig(steps=4))


def test_expert_unused_for_longest_is_dropped(cache: ExpertCache) -> None:
    first, second, third = adaptation(), adaptation(), adaptation()
    cache.keep('a', first)
    cache.keep('b', second)
    assert cache.find('a') is first
    cache.keep('c', third)
    assert (cache.find('a'), cache.find('b'), cache.find('c')) == (first, None, third)
    assert len(cache) == 2


def test_only_experts_are_kept_and_none_without_size(cache: ExpertCache) -> None:
    cache.keep('a', adaptation(accepted=False))
    assert cache.find('a') is None
    off = ExpertCache(0, cell_m=1.0, position_dims=(0, 1))
    off.keep('a', adaptation())
    assert len(off) == 0
