"""Getting up: which of the two policies acts, and that the packaged humanoid does stand up."""

from typing import Any

import numpy as np
import pytest
from sim_bridge import make_simulator
from sim_bridge.controllers import make_direction_follower
from sim_bridge.controllers.humanoid import head_height
from sim_bridge.controllers.rising import RisingHumanoid, STEADY_STEPS

NORTH = np.array([0.0, 1.0])


class Told:
    """A policy whose action is its number, and that remembers the directions it was given."""

    def __init__(self, number: float) -> None:
        self.number = number
        self.sha256 = f'{number:g}'
        self.directions: list[list[float]] = []

    def act(self, observation: Any, direction: Any, qpos: Any) -> np.ndarray:
        self.directions.append(direction.tolist())
        return np.array([self.number])


def chosen(heads: list[float]) -> list[float]:
    """What acts at each of these heights of the head: 1 walks, 2 gets up."""
    walker, riser = Told(1), Told(2)
    follower = RisingHumanoid(walker, riser)  # type: ignore[arg-type]
    actions = []
    for head in heads:
        observation = np.zeros(69)
        observation[23] = head
        actions.append(follower.act(observation, NORTH, np.zeros(28)).item())
    assert walker.directions == [[0.0, 1.0]] * actions.count(1)
    assert riser.directions == [[0.0, 0.0]] * actions.count(2)
    return actions


def test_walks_down_to_a_low_head_and_again_once_it_stood_for_a_while() -> None:
    assert chosen([1.4, 1.0, 0.91]) == [1, 1, 1]
    assert chosen([0.89, *[1.2] * 100]) == [2] * 101
    assert chosen([0.89, *[1.3] * STEADY_STEPS]) == [2] * STEADY_STEPS + [1]
    swaying = [0.89, *[1.3] * (STEADY_STEPS - 1), 1.2]
    assert chosen([*swaying, *[1.3] * STEADY_STEPS])[-2:] == [2, 1]


def test_hash_tells_both_policies_apart() -> None:
    def sha256(*numbers: float) -> str:
        return RisingHumanoid(*map(Told, numbers)).sha256  # type: ignore[arg-type]

    assert len({sha256(1, 2), sha256(2, 1), sha256(1, 3)}) == 3


@pytest.mark.mujoco
def test_humanoid_of_the_package_gets_up_where_ogbench_drops_it() -> None:
    stood = 0
    with make_simulator('humanoidmaze-medium-v0') as humanoid:
        for seed in range(5):
            follower = make_direction_follower(humanoid.spec)
            observation, _ = humanoid.reset(task_id=1, seed=seed)
            for _ in range(200):
                observation = humanoid.step(
                    follower.act(observation, NORTH, humanoid.qpos)
                ).observation
            stood += head_height(observation) > 1.2
    assert stood >= 3
