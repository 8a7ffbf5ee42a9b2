"""Where the humanoid learns to get up: drops, the fading lift, and going on after a stop."""

import numpy as np
import pytest
from sim_bridge.controllers import humanoid_get_up
from sim_bridge.controllers.humanoid_get_up import GetUpCourse, GetUpGround
from sim_bridge.controllers.humanoid_reward import standing_reward
from sim_bridge.mazes.ogbench import standing_pose

pytestmark = pytest.mark.mujoco


def ground(seed: int = 0, **course) -> GetUpGround:
    return GetUpCourse(**{'floors': 3, **course}).ground(np.random.default_rng(seed))


def lie(ours: GetUpGround, steps: int = 80) -> None:
    """Let everyone fall, limp and without a lift."""
    lift, ours.lift = ours.lift, 0.0
    ours._steps[:] = 0
    for _ in range(steps):
        ours.step(np.zeros((ours.count, 21)), np.random.default_rng(0))
    ours.lift = lift


def stand(ours: GetUpGround, index: int) -> None:
    env = ours._envs[index]
    qpos, _ = standing_pose((0.0, 0.0), np.random.default_rng(0))
    env.set_state(qpos, np.zeros(env.model.nv))


def test_reward_is_the_formula_worked_out_by_hand() -> None:
    def reward(head: float, vertical: float, action: float = 0.0) -> float:
        observation = np.zeros((1, 69))
        observation[0, 23], observation[0, 38] = head, vertical
        return standing_reward(observation, np.full((1, 21), action)).item()

    assert reward(1.35, 1.0) == pytest.approx(0.4)
    assert reward(1.49, 1.0) == pytest.approx(0.4)
    assert reward(0.1, 0.0) == 0.0
    assert reward(0.725, 1.0) == pytest.approx(0.4 * (0.2 + 0.15))
    assert reward(0.725, -1.0) == pytest.approx(0.4 * 0.2)
    assert reward(1.35, 1.0, action=-1.0) == pytest.approx(0.4 * 0.95)


def test_humanoids_are_dropped_in_poses_of_their_own_and_lie_in_the_end() -> None:
    ours = ground()
    assert len(np.unique(ours.inputs[:, :21], axis=0)) == 3
    np.testing.assert_array_equal(ours.inputs[:, 64:], 0.0)  # no direction
    lie(ours)
    assert (ours.inputs[:, 21] < 0.6).all()


def test_lift_raises_who_lies_and_leaves_alone_who_stands() -> None:
    ours = ground(lift=1.5)
    lie(ours)
    before = ours.inputs[:, 21].copy()
    ours.step(np.zeros((3, 21)), np.random.default_rng(0))
    forces = [env.data.xfrc_applied[1, 2] for env in ours._envs]
    assert forces == pytest.approx([1.5 * 40.844 * 9.81] * 3, rel=1e-4)
    for _ in range(11):
        ours.step(np.zeros((3, 21)), np.random.default_rng(0))
    assert (ours.inputs[:, 21] > before + 0.1).all()
    stand(ours, 0)
    ours.step(np.zeros((3, 21)), np.random.default_rng(0))
    assert ours._envs[0].data.xfrc_applied[1, 2] == 0.0


def test_lift_fades_by_those_who_stand_after_five_seconds() -> None:
    ours = ground(floors=4, lift=0.8, fade=0.01)
    lie(ours)
    ours.lift = 0.5

    def after_5_s(standing: int) -> dict[str, float]:
        for index in range(standing):
            stand(ours, index)
        ours._steps[:] = humanoid_get_up.RISE_STEPS - 1
        return ours.step(np.zeros((4, 21)), np.random.default_rng(0)).figures

    assert after_5_s(standing=3) == {'lift': pytest.approx(0.48), 'stood_after_5_s': 0.75}
    for _ in range(40):  # they fall again
        ours.step(np.zeros((4, 21)), np.random.default_rng(0))
    lie(ours)
    assert after_5_s(standing=0) == {'lift': pytest.approx(0.52), 'stood_after_5_s': 0.0}
    ours.lift = 0.79
    assert after_5_s(standing=0)['lift'] == 0.8
    ours.lift = 0.01
    assert after_5_s(standing=4)['lift'] == 0.0


def test_episode_ends_by_a_drop_which_is_no_fall(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(humanoid_get_up, 'EPISODE_STEPS', 4)
    ours = ground()
    ours._steps[:] = 0
    steps = [ours.step(np.zeros((3, 21)), np.random.default_rng(number)) for number in range(8)]
    assert [step.cut.all() for step in steps] == 2 * [False, False, False, True]
    assert not any(step.fallen.any() for step in steps)
    heights = [env.data.qpos[2] for env in ours._envs]
    assert heights == [1.5] * 3
    assert (ours.inputs[:, :21] != steps[-1].next_inputs[:, :21]).all()


def test_restored_ground_goes_on_bit_by_bit() -> None:
    ours, theirs = ground(), ground(seed=9)
    actions = np.random.default_rng(0).uniform(-1, 1, (60, 3, 21))
    for number in range(30):
        ours.step(actions[number], np.random.default_rng(number))
    theirs.load_arrays({name: array.copy() for name, array in ours.arrays().items()})
    np.testing.assert_array_equal(theirs.inputs, ours.inputs)
    for number in range(30, 60):
        ours.step(actions[number], np.random.default_rng(number))
        theirs.step(actions[number], np.random.default_rng(number))
        np.testing.assert_array_equal(theirs.inputs, ours.inputs)
        assert theirs.lift == ours.lift
