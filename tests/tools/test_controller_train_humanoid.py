"""Training, measuring and using a humanoid's controller, in miniature."""

import json
from pathlib import Path

from metagcttt_core import TrajectoryDataset
from metagcttt_tools import controller_measure, controller_train_humanoid, generate
from metagcttt_tools.controller import film
import numpy as np
from PIL import Image
import pytest
from sim_bridge.controllers import HumanoidFollower, load_follower
from sim_bridge.controllers.direction import GET_UP
from sim_bridge.controllers.rising import RisingHumanoid

pytestmark = pytest.mark.mujoco


def train(out: Path, *more: str) -> None:
    controller_train_humanoid.main(
        ['--out', str(out), '--length', '0.0002', '--log-every', '2', *more]
    )


@pytest.fixture(scope='module')
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp('humanoid')
    train(out)
    return out


def test_run_leaves_a_controller_a_checkpoint_and_logs(trained: Path) -> None:
    follower = load_follower(trained / 'controller')
    assert isinstance(follower, HumanoidFollower)
    assert (follower.obs_dim, follower.act_dim, follower.layer_norm) == (69, 21, True)
    assert follower.metadata['sweeps'] == 4 + 2 + 3
    lines = [json.loads(line) for line in (trained / 'metrics.jsonl').read_text().splitlines()]
    assert [line['step'] for line in lines] == [2, 4, 6, 8]
    assert {'reward_per_step', 'speed_m_s', 'falls_per_1000_steps'} <= lines[0].keys()
    assert sum(path.stat().st_size for path in (trained / 'controller').iterdir()) < 1_000_000


def test_finished_run_is_not_trained_over(
    trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = load_follower(trained / 'controller').sha256
    with pytest.raises(SystemExit):
        train(trained)
    assert '--resume' in capsys.readouterr().err
    train(trained, '--resume')
    assert load_follower(trained / 'controller').sha256 == before


def test_run_out_of_time_saves_and_asks_to_be_queued_again(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        train(tmp_path, '--time-limit', '1e-9')
    assert ended.value.code == 75
    assert (tmp_path / 'checkpoint.safetensors').exists()
    with pytest.raises(SystemExit, match='75'):  # a sweep at a time
        train(tmp_path, '--time-limit', '1e-9', '--resume')
    assert load_follower(tmp_path / 'controller').metadata['sweeps'] == 2


def test_other_seed_is_another_run(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        train(trained, '--resume', '--seed', '5')
    assert 'cannot resume, seed was 0 and is now 5' in capsys.readouterr().err


def test_training_to_get_up_logs_the_lift_and_leaves_a_controller(tmp_path: Path) -> None:
    train(tmp_path, '--task', 'get-up')
    follower = load_follower(tmp_path / 'controller')
    assert (follower.obs_dim, follower.metadata['sweeps']) == (69, 20)
    lines = [json.loads(line) for line in (tmp_path / 'metrics.jsonl').read_text().splitlines()]
    assert [line['step'] for line in lines] == list(range(2, 21, 2))
    assert {'reward_per_step', 'lift', 'stood_after_5_s'} <= lines[0].keys()
    assert lines[0]['lift'] == 0.8


def test_controller_makes_data_that_end_before_a_fall(trained: Path, tmp_path: Path) -> None:
    generate.main(
        [
            *('--environment', 'humanoidmaze-medium-v0', '--episodes', '2', '--processes', '1'),
            *('--controller', str(trained / 'controller'), '--rows-per-episode', '200'),
            *('--output', str(tmp_path / 'humanoid.npz'), '--standing'),
        ]
    )
    dataset = TrajectoryDataset.load(tmp_path / 'humanoid.npz')
    assert (dataset.obs_dim, dataset.act_dim) == (69, 21)
    assert 2 * 2 <= dataset.num_rows < 2 * 200  # nobody walks yet
    assert dataset.terminals.sum() == 2
    assert dataset.observations[:, 23].min() > 0.9
    np.testing.assert_allclose(dataset.observations[dataset.episode_starts, 23], 1.49, atol=0.01)
    sidecar = json.loads((tmp_path / 'humanoid.json').read_text())
    assert sidecar['standing'] is True
    assert (
        sidecar['controller_sha256']
        == RisingHumanoid(
            HumanoidFollower.load(trained / 'controller'), HumanoidFollower.load(GET_UP)
        ).sha256
    )
    assert sidecar['statistics']['falls_per_episode'] == 0


def test_measurement_counts_falls(trained: Path, tmp_path: Path) -> None:
    controller_measure.main(
        [
            *('--controller', str(trained / 'controller'), '--out', str(tmp_path / 'humanoid')),
            *('--directions', '1', '--repeats', '1', '--duration-s', '3', '--walks', '1'),
            *('--mazes', 'medium', '--episodes-per-task', '1'),
        ]
    )
    report = json.loads((tmp_path / 'humanoid.json').read_text())
    for row in (*report['directions'], *report['walks']):
        assert row['falls'] >= 1
    upright, dropped = (
        [row for row in report['mazes'] if row['start'] == start]
        for start in ('upright', 'dropped')
    )
    for row in upright:
        assert (row['reached'], row['falls'], row['episodes']) == (0, 5, 5)
    for row in dropped:  # up again after each fall, until the time is over
        assert row['falls'] > 5
        assert row['seconds_to_goal'] is None


def test_film_shows_the_walk(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(robot: str, walk: film.Walk) -> list[np.ndarray]:
        assert (robot, len(walk.directions)) == ('humanoid', 20)
        stripes = np.zeros((4, 6, 3), np.uint8)
        stripes[:, 0] = 240, 60, 80
        return [np.roll(stripes, shift, axis=1) for shift in range(3)]

    monkeypatch.setattr(film, 'draw_walk', draw)
    film.film(load_follower(trained / 'controller'), tmp_path / 'walk.gif', 0, duration_s=0.5)
    with Image.open(tmp_path / 'walk.gif') as picture:
        assert (picture.n_frames, picture.size) == (3, (6, 4))
        picture.seek(2)
        colours = np.array(picture.convert('RGB'))
    assert colours[0, 2].tolist() == [240, 60, 80]
    assert not colours[:, 3:].any()
