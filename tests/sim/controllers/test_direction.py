"""Controllers that follow directions."""

import numpy as np
import pytest
from sim_bridge import describe_environment
from sim_bridge.controllers import ControllerError, make_direction_follower


def test_point_moves_in_the_direction_itself() -> None:
    follower = make_direction_follower(describe_environment('pointmaze-giant-v0').spec)
    direction = np.array([0.6, -0.8])
    np.testing.assert_array_equal(follower.act(np.zeros(2), direction), direction)


@pytest.mark.parametrize('robot', ['antmaze', 'humanoidmaze'])
def test_robot_without_a_controller_is_refused_with_what_is_missing(robot: str) -> None:
    with pytest.raises(ControllerError, match=f'{robot}-medium-v0: .*learned direction control'):
        make_direction_follower(describe_environment(f'{robot}-medium-v0').spec)
