"""Training and measuring a controller, in miniature."""

import json
from pathlib import Path

from metagcttt_tools import controller_measure, controller_train
from metagcttt_tools.controller_train import ControllerTraining, TrainControllerSettings
import numpy as np
import pytest
from safetensors.torch import load_file
from sim_bridge.controllers import LearnedFollower
from tests.tools.tables import squeezed
import torch

pytestmark = pytest.mark.mujoco
TINY = [
    *('--random-steps', '20', '--checkpoint-every', '25', '--log-every', '10'),
    *('--sac.batch-size', '8', '--sac.actor-hidden', '8', '--sac.critic-hidden', '8'),
]


def train(out: Path, steps: int, *more: str) -> None:
    controller_train.main(['--out', str(out), '--steps', str(steps), *TINY, *more])


@pytest.fixture(scope='module')
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp('ant')
    train(out, 40)
    return out


def test_run_leaves_a_controller_a_checkpoint_and_logs(trained: Path) -> None:
    follower = LearnedFollower.load(trained / 'controller')
    assert (follower.robot, follower.obs_dim, follower.act_dim) == ('ant', 29, 8)
    assert follower.metadata['steps'] == 40
    lines = (trained / 'metrics.jsonl').read_text().splitlines()
    assert [json.loads(line)['step'] for line in lines] == [10, 20, 30, 40]
    assert {'reward_per_step', 'falls', 'critic_loss'} <= json.loads(lines[-1]).keys()
    checkpoint = load_file(trained / 'checkpoint.safetensors')
    assert checkpoint['replay.rewards'].shape == (40,)
    assert checkpoint['replay.next_observations'].isfinite().all()


def test_controller_is_the_mean_of_the_actor(trained: Path) -> None:
    follower = LearnedFollower.load(trained / 'controller')
    settings = json.loads((trained / 'settings.json').read_text())['settings']
    training = ControllerTraining(TrainControllerSettings.model_validate(settings))
    training.restore()
    observation, direction = np.linspace(-1, 1, 29), np.array([0.6, 0.8])
    inputs = torch.tensor([*observation[2:], *direction], dtype=torch.float32)
    mean = training.learner.actor(inputs[None])[0, 0, :8].tanh()
    np.testing.assert_allclose(
        follower.act(observation, direction, np.zeros(15)),
        mean.detach().numpy(),
        rtol=1e-4,
        atol=1e-6,
    )


def test_resumed_run_keeps_the_transitions_and_goes_on(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = load_file(trained / 'checkpoint.safetensors')
    with pytest.raises(SystemExit):
        train(trained, 60)
    assert 'pass --resume' in capsys.readouterr().err
    train(trained, 60, '--resume')
    after = load_file(trained / 'checkpoint.safetensors')
    for name in ('observations', 'actions', 'rewards', 'masks'):
        rows = after[f'replay.{name}']
        assert len(rows) == 60
        assert torch.equal(rows[:40], before[f'replay.{name}'])
    assert not torch.equal(after['actor.weights.0'], before['actor.weights.0'])
    with pytest.raises(SystemExit):
        train(trained, 80, '--resume', '--sac.lr', '0.1')
    assert 'cannot resume, sac.lr was' in capsys.readouterr().err


def test_stopped_run_saves_every_step_so_far(tmp_path: Path) -> None:
    settings = TrainControllerSettings(
        out=tmp_path, steps=500, sac={'batch_size': 8, 'actor_hidden': (8,), 'critic_hidden': (8,)}
    )
    asked = iter([False] * 6 + [True])
    training = ControllerTraining(settings)
    assert not training.run(log=lambda step, scalars: None, should_stop=lambda: next(asked))
    assert len(load_file(tmp_path / 'checkpoint.safetensors')['replay.rewards']) == 7


def test_run_out_of_time_saves_and_asks_to_be_queued_again(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        train(tmp_path, 40, '--time-limit', '1e-9')
    assert ended.value.code == 75
    steps = len(load_file(tmp_path / 'checkpoint.safetensors')['replay.rewards'])
    assert 0 < steps < 40
    train(tmp_path, 40, '--resume')  # without a limit again, as it is each call's own
    assert LearnedFollower.load(tmp_path / 'controller').metadata['steps'] == 40


def test_learning_rate_falls_to_zero_over_the_last_steps(tmp_path: Path) -> None:
    sac = {'batch_size': 8, 'actor_hidden': (8,), 'critic_hidden': (8,), 'lr': 0.1}
    settings = TrainControllerSettings(
        out=tmp_path, steps=40, decay_steps=20, random_steps=5, log_every=2, sac=sac
    )
    training = ControllerTraining(settings)
    rates = {}
    training.run(
        log=lambda step, _: rates.update({step: training.learner.optimizer.param_groups[0]['lr']})
    )
    assert rates[20] == pytest.approx(0.1)
    assert rates[30] == pytest.approx(0.1 * 11 / 20)  # the 30th step and ten more
    assert rates[40] == pytest.approx(0.1 * 1 / 20)


def test_same_seed_gives_the_same_controller(tmp_path: Path) -> None:
    for name in 'ab':
        train(tmp_path / name, 30)
    hashes = {LearnedFollower.load(tmp_path / name / 'controller').sha256 for name in 'ab'}
    assert len(hashes) == 1


def test_measurement_tells_speed_and_falls_by_direction(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    controller_measure.main(
        [
            *('--controller', str(trained / 'controller'), '--out', str(tmp_path / 'ant')),
            *('--directions', '3', '--repeats', '2', '--duration-s', '1', '--walks', '4'),
            *('--mazes', 'medium', '--episodes-per-task', '1', '--action-noise', '0.1'),
        ]
    )
    report = json.loads((tmp_path / 'ant.json').read_text())
    assert [row['direction_deg'] for row in report['directions']] == [0, 120, 240]
    for row in report['directions']:
        assert row['walks'] == 2
        assert row['slowest_m_s'] <= row['speed_m_s']
    rows = [
        (len(row['turns_deg']), row['action_noise'], row['walked_s']) for row in report['walks']
    ]
    assert rows == [(0, 0.0, 4.0), (0, 0.1, 4.0), (3, 0.0, 4.0), (3, 0.1, 4.0)]
    assert [row['maze'] for row in report['mazes']] == 2 * ['antmaze-medium-v0']
    for row in report['mazes']:
        assert row['reached'] <= row['episodes'] == 5
        assert row['falls_per_minute'] == pytest.approx(60 * row['falls'] / row['walked_s'])
    assert report['settings']['repeats'] == 2
    assert 'out' not in report['settings']
    assert (tmp_path / 'ant.png').stat().st_size > 10_000
    text = (tmp_path / 'ant.md').read_text()
    assert text in capsys.readouterr().out
    for start in ('| 240° |', '| straight on | 0.1 |', '| antmaze-medium-v0 | upright | 0 |'):
        assert start in squeezed(text)
