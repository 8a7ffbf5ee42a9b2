"""The links of a robot are where the simulator has them."""

from metagcttt_tools.live.body import Body
import numpy as np
import pytest
from sim_bridge import make_simulator

pytestmark = pytest.mark.mujoco


def walked(environment: str):
    """Observation and link positions (n, 3) of the simulator after some random steps."""
    rng = np.random.default_rng(0)
    with make_simulator(environment) as simulator:
        simulator.reset_free(seed=0)
        for _ in range(12):
            result = simulator.step(rng.uniform(-1, 1, simulator.spec.act_dim))
        model, data = simulator.environment.model, simulator.environment.data
        links = np.flatnonzero(model.body_rootid == model.body('torso').id)
        return result.observation, data.xpos[links].copy()


@pytest.mark.parametrize('environment', ['antmaze-medium-v0', 'AntMaze_UMaze-v5'])
def test_ant_has_the_pose_of_the_simulator(environment: str) -> None:
    observation, expected = walked(environment)
    body = Body(environment)
    positions = np.array([position for position, _ in body.pose(observation)])
    np.testing.assert_allclose(positions, expected, atol=0.02)
    size = np.ptp(np.concatenate([mesh.bounds for mesh in body.meshes]), axis=0)
    assert (size[:2] > 0.5).all()


def test_humanoid_has_the_pose_of_the_simulator_but_for_its_heading() -> None:
    observation, expected = walked('humanoidmaze-medium-v0')
    body = Body('humanoidmaze-medium-v0')
    positions = np.array([position for position, _ in body.pose(observation)])
    np.testing.assert_allclose(positions[0, :2], expected[0, :2], atol=0.02)
    np.testing.assert_allclose(positions[:, 2], expected[:, 2], atol=0.02)
    between = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (positions, expected)]
    np.testing.assert_allclose(*between, atol=0.02)


def test_humanoid_looks_where_it_goes() -> None:
    observation, _ = walked('humanoidmaze-medium-v0')
    body = Body('humanoidmaze-medium-v0')
    observation[36:39], observation[39:42] = (0, 0, 1), (0, -1.5, 0)  # upright, along -y
    for speed in (1.0, 0.01):  # it keeps its heading when it stands
        observation[39:42] *= speed
        w, x, y, z = body.pose(observation)[0][1]
        forward = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z))
        assert forward == pytest.approx((0, -1), abs=1e-6)


def test_point_has_no_links() -> None:
    with pytest.raises(ValueError, match='no links'):
        Body('pointmaze-medium-v0')
