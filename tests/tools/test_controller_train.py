"""Training and measuring a controller, in miniature."""

import json
from pathlib import Path

from metagcttt_core import TrajectoryDataset
from metagcttt_tools import controller_measure, controller_train, generate
from metagcttt_tools.controller_train import (
    ControllerTraining,
    ReplayBuffer,
    TrainControllerSettings,
)
import numpy as np
import pytest
from safetensors.torch import load_file
from sim_bridge.controllers import LearnedFollower
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
        follower.act(observation, direction), mean.detach().numpy(), rtol=1e-4, atol=1e-6
    )


def test_resumed_run_keeps_the_transitions_and_goes_on(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = load_file(trained / 'checkpoint.safetensors')
    with pytest.raises(SystemExit):
        train(trained, 60)
    assert 'go on with --resume' in capsys.readouterr().err
    train(trained, 60, '--resume')
    after = load_file(trained / 'checkpoint.safetensors')
    for name in ('observations', 'actions', 'rewards', 'masks'):
        rows = after[f'replay.{name}']
        assert len(rows) == 60
        assert torch.equal(rows[:40], before[f'replay.{name}'])
    assert not torch.equal(after['actor.weights.0'], before['actor.weights.0'])
    with pytest.raises(SystemExit):
        train(trained, 80, '--resume', '--sac.lr', '0.1')
    assert 'cannot resume, sac was' in capsys.readouterr().err


def test_stopped_run_saves_every_step_so_far(tmp_path: Path) -> None:
    settings = TrainControllerSettings(
        out=tmp_path, steps=500, sac={'batch_size': 8, 'actor_hidden': (8,), 'critic_hidden': (8,)}
    )
    asked = iter([False] * 6 + [True])
    training = ControllerTraining(settings)
    assert not training.run(log=lambda step, scalars: None, should_stop=lambda: next(asked))
    assert len(load_file(tmp_path / 'checkpoint.safetensors')['replay.rewards']) == 7


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


def test_replay_draws_whole_transitions_of_those_there_are() -> None:
    replay = ReplayBuffer(capacity=10, obs_dim=1, act_dim=1)
    for number in range(4):
        replay.add(
            observations=number, actions=number, next_observations=number + 1, rewards=number,
            masks=1,
        )  # fmt: skip
    drawn = replay.sample(200, np.random.default_rng(0))
    assert set(drawn['rewards'].tolist()) == {0, 1, 2, 3}
    assert torch.equal(drawn['observations'][:, 0] + 1, drawn['next_observations'][:, 0])
    assert torch.equal(drawn['observations'][:, 0], drawn['rewards'])


def test_full_replay_forgets_the_oldest_and_comes_back_as_it_was() -> None:
    def add(replay: ReplayBuffer, number: int) -> None:
        replay.add(observations=number, actions=0, next_observations=0, rewards=number, masks=1)

    replay, copy = (ReplayBuffer(capacity=3, obs_dim=1, act_dim=1) for _ in range(2))
    for number in range(5):
        add(replay, number)
    copy.load_tensors(replay.tensors())
    for each in (replay, copy):
        add(each, 5)
        assert (each.size, each.added) == (3, 6)
        assert sorted(each.arrays['rewards']) == [3, 4, 5]
        drawn = each.sample(100, np.random.default_rng(0))
        assert set(drawn['observations'][:, 0].tolist()) == {3, 4, 5}


def test_measurement_tells_speed_and_falls_by_direction(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    controller_measure.main(
        [
            *('--controller', str(trained / 'controller'), '--out', str(tmp_path / 'ant')),
            *('--directions', '3', '--repeats', '2', '--duration-s', '1'),
        ]
    )
    report = json.loads((tmp_path / 'ant.json').read_text())
    assert [row['direction_deg'] for row in report['directions']] == [0, 120, 240]
    for row in report['directions']:
        assert row['walks'] == 2
        assert row['slowest_m_s'] <= row['speed_m_s']
    assert report['settings'] == {'directions': 3, 'duration_s': 1.0, 'repeats': 2, 'seed': 0}
    assert (tmp_path / 'ant.png').stat().st_size > 10_000
    assert '| 240° |' in capsys.readouterr().out


def test_humanoid_goes_through_the_same_code(tmp_path: Path) -> None:
    train(tmp_path, 30, '--robot', 'humanoid', '--update-every', '4', '--sac.critics', 'mean')
    generate.main(
        [
            *('--environment', 'humanoidmaze-medium-v0', '--episodes', '1', '--processes', '1'),
            *('--controller', str(tmp_path / 'controller'), '--rows-per-episode', '12'),
            *('--output', str(tmp_path / 'humanoid.npz')),
        ]
    )
    dataset = TrajectoryDataset.load(tmp_path / 'humanoid.npz')
    assert (dataset.num_rows, dataset.obs_dim, dataset.act_dim) == (12, 69, 21)
    sidecar = json.loads((tmp_path / 'humanoid.json').read_text())
    follower = LearnedFollower.load(tmp_path / 'controller')
    assert sidecar['controller_sha256'] == follower.sha256
