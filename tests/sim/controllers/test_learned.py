"""Learned controllers: what they compute, and files that come back or are refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from sim_bridge.controllers import ControllerError, LearnedFollower


def follower(seed: int = 0) -> LearnedFollower:
    """Observations of 5 numbers (x and y among them), actions of 2."""
    rng = np.random.default_rng(seed)
    shapes = [(5, 7), (7, 4), (4, 2)]
    return LearnedFollower(
        'snail',
        tuple(rng.normal(size=shape).astype(np.float32) for shape in shapes),
        tuple(rng.normal(size=shape[1]).astype(np.float32) for shape in shapes),
        {'steps': 3},
    )


def test_action_is_a_perceptron_of_own_state_and_direction() -> None:
    weights = np.zeros((3, 2), np.float32), np.array([[1.0], [-2.0]], np.float32)
    weights[0][:, 0] = 1, 10, 100
    weights[0][:, 1] = -1, 0, 0
    biases = np.array([0.5, 0.0], np.float32), np.array([-5.0], np.float32)
    snail = LearnedFollower('snail', weights, biases)
    # Own state 0.25, direction (0.6, -0.01): hidden 0.25 + 6 - 1 + 0.5 = 5.75 and max(-0.25, 0).
    action = snail.act(np.array([8.0, 9.0, 0.25]), np.array([0.6, -0.01]), np.zeros(3))
    np.testing.assert_allclose(action, np.tanh([0.75]), rtol=1e-6)
    assert action.dtype == np.float64
    assert (snail.obs_dim, snail.act_dim) == (3, 1)


def test_saved_controller_comes_back(tmp_path: Path) -> None:
    saved = follower()
    saved.save(tmp_path / 'snail')
    loaded = LearnedFollower.load(tmp_path / 'snail')
    assert (loaded.robot, loaded.metadata) == ('snail', {'steps': 3})
    assert loaded.sha256 == saved.sha256 != follower(seed=1).sha256
    for ours, theirs in zip(
        (*saved.weights, *saved.biases), (*loaded.weights, *loaded.biases), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


def test_new_controller_takes_the_place_of_the_old_one_and_leaves_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    follower(0).save(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr('metagcttt_core.files.write_json', interrupt)
        with pytest.raises(KeyboardInterrupt):
            follower(1).save(tmp_path)
    assert LearnedFollower.load(tmp_path).sha256 == follower(0).sha256
    follower(1).save(tmp_path)
    assert LearnedFollower.load(tmp_path).sha256 == follower(1).sha256
    assert len(list(tmp_path.iterdir())) == 2


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def test_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ControllerError, match='nowhere: no direction controller there'):
        LearnedFollower.load(tmp_path / 'nowhere')


def test_weights_of_another_controller_are_refused(tmp_path: Path) -> None:
    follower(0).save(tmp_path / 'a')
    follower(1).save(tmp_path / 'b')
    (ours,), (theirs,) = ((tmp_path / name).glob('weights-*') for name in 'ab')
    theirs.replace(ours)
    with pytest.raises(ControllerError, match='does not match the hash'):
        LearnedFollower.load(tmp_path / 'a')


@pytest.mark.parametrize('pattern', ['controller.json', 'weights-*'])
def test_damaged_file_is_refused(tmp_path: Path, pattern: str) -> None:
    follower().save(tmp_path)
    (file,) = tmp_path.glob(pattern)
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(ControllerError, match='holds no usable controller'):
        LearnedFollower.load(tmp_path)


def test_file_of_a_later_version_is_refused(tmp_path: Path) -> None:
    follower().save(tmp_path)
    index = json.loads((tmp_path / 'controller.json').read_text())
    (tmp_path / 'controller.json').write_text(json.dumps({**index, 'version': 2}))
    with pytest.raises(ControllerError, match='version'):
        LearnedFollower.load(tmp_path)


def test_layers_that_do_not_fit_or_are_not_finite_are_refused() -> None:
    good = follower()
    with pytest.raises(ControllerError, match=r'layers \(5, 7\) and \(4, 2\) do not fit'):
        LearnedFollower('snail', (good.weights[0], good.weights[2]), good.biases[:2])
    with pytest.raises(ControllerError, match=r'layer \(5, 7\) has a bias of shape \(4,\)'):
        LearnedFollower('snail', good.weights, (good.biases[1], *good.biases[1:]))
    with pytest.raises(ControllerError, match='finite float32'):
        LearnedFollower('snail', good.weights, (*good.biases[:2], np.full(2, np.nan, np.float32)))
