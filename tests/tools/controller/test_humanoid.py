"""How the humanoid's learner gathers transitions, mirrors them, and goes on after a stop."""

from pathlib import Path

from metagcttt_tools.controller import humanoid
from metagcttt_tools.controller.humanoid import (
    HumanoidTraining,
    mirror_some,
    Stage,
    STAGES,
)
import numpy as np
import pytest
from safetensors.torch import load_file
from sim_bridge.controllers.humanoid import mirror_action, mirror_inputs
from sim_bridge.controllers.humanoid_get_up import GetUpCourse
from sim_bridge.controllers.humanoid_ground import Course
import torch

STAGES_IN_MINIATURE = (
    Stage('walk', Course(floors=4, turn_rad=(0.6, 3.0), turn_steps=10), 20, (1, 1)),
    Stage('mazes', Course(floors=1, mazes=('medium',), noisy=0.5, p_push=0.2), 40, (1, 0.2)),
)


def test_half_of_the_transitions_are_mirrored_as_wholes() -> None:
    rng = np.random.default_rng(0)
    arrays = {
        'observations': rng.normal(size=(400, 67)),
        'next_observations': rng.normal(size=(400, 67)),
        'actions': rng.normal(size=(400, 21)),
        'rewards': rng.normal(size=400),
    }
    batch = {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
    mixed = mirror_some(batch, rng)
    mirrored = (mixed['actions'] != batch['actions']).any(dim=1).numpy()
    assert 150 < mirrored.sum() < 250
    for name, mirror in (
        ('observations', mirror_inputs),
        ('next_observations', mirror_inputs),
        ('actions', mirror_action),
    ):
        ours, theirs = batch[name].numpy(), mixed[name].numpy()
        np.testing.assert_array_equal(theirs[mirrored], mirror(ours[mirrored]))
        np.testing.assert_array_equal(theirs[~mirrored], ours[~mirrored])
    assert torch.equal(mixed['rewards'], batch['rewards'])


@pytest.fixture(autouse=True)
def learn_early(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(humanoid, 'WARM_UP', 20)


def training(out: Path, stages: tuple[Stage, ...] = STAGES_IN_MINIATURE) -> HumanoidTraining:
    return HumanoidTraining(out, 0, stages)


def forget(*_: object) -> None:
    """Log nothing."""


@pytest.mark.mujoco
def test_run_stopped_in_each_stage_and_resumed_ends_with_the_same_bits(tmp_path: Path) -> None:
    assert training(tmp_path / 'whole').run(forget)
    for stop_at in (13, 20, 45):
        part = training(tmp_path / 'parts')
        if part.checkpoint.exists():
            part.restore()
        assert not part.run(forget, should_stop=lambda part=part, at=stop_at: part.sweep == at)
    last = training(tmp_path / 'parts')
    last.restore()
    assert last.sweep == 45
    assert last.run(forget)
    whole, parts = (
        load_file(tmp_path / name / 'checkpoint.safetensors') for name in ('whole', 'parts')
    )
    assert whole.keys() == parts.keys()
    for name, tensor in whole.items():
        assert torch.equal(tensor, parts[name]), name
    assert not torch.equal(whole['actor.weights.0'], whole['average.0'])


@pytest.mark.mujoco
def test_get_up_run_stopped_and_resumed_ends_with_the_same_bits(tmp_path: Path) -> None:
    stages = (Stage('get-up', GetUpCourse(floors=4), 40, (1, 0.2)),)
    assert training(tmp_path / 'whole', stages).run(forget)
    part = training(tmp_path / 'parts', stages)
    assert not part.run(forget, should_stop=lambda: part.sweep == 17)
    last = training(tmp_path / 'parts', stages)
    last.restore()
    assert last.run(forget)
    whole, parts = (
        load_file(tmp_path / name / 'checkpoint.safetensors') for name in ('whole', 'parts')
    )
    for name, tensor in whole.items():
        assert torch.equal(tensor, parts[name]), name


@pytest.mark.mujoco
def test_follower_is_the_mean_of_the_averaged_actor(tmp_path: Path) -> None:
    ours = training(tmp_path)
    ours.run(forget)
    ours.learner.actor.load_state_dict(
        dict(zip(ours.learner.actor.state_dict(), ours.average, strict=True))
    )
    inputs = np.random.default_rng(0).normal(size=(5, 67)).astype(np.float32)
    mean = ours.learner.actor(torch.from_numpy(inputs))[0, :, :21].tanh().detach()
    np.testing.assert_allclose(ours.follower().network(inputs), mean.numpy(), atol=1e-5)
    assert ours.follower().metadata['sweeps'] == 60


@pytest.mark.mujoco
def test_learning_rates_fall_from_stage_to_stage(tmp_path: Path) -> None:
    ours, seen = training(tmp_path), {}
    groups = ours.learner.optimizer.param_groups
    ours.run(
        lambda sweep, _: seen.update({sweep: [group['lr'] for group in groups]}), log_every=10
    )
    assert seen[20] == pytest.approx([3e-4, 5e-4, 3e-4])
    # The 20th of 40 sweeps, and the last one.
    np.testing.assert_allclose(seen[40], np.array([3e-4, 5e-4, 3e-4]) * (1 - 0.8 * 19 / 40))
    np.testing.assert_allclose(seen[60], np.array([3e-4, 5e-4, 3e-4]) * (1 - 0.8 * 39 / 40))


@pytest.mark.mujoco
def test_stage_begins_with_nothing_to_learn_from(tmp_path: Path) -> None:
    ours = training(tmp_path)
    ours.run(forget, should_stop=lambda: ours.sweep == 19)
    assert ours._replay.size > 40
    assert ours.stage.name == 'walk'
    ours.run(forget, should_stop=lambda: ours.sweep == 20)
    assert ours._replay.size == 0
    assert ours.stage.name == 'mazes'


@pytest.mark.mujoco
def test_checkpoint_of_other_stages_is_refused(tmp_path: Path) -> None:
    ours = training(tmp_path)
    ours.run(forget, should_stop=lambda: True)
    with pytest.raises(ValueError, match='cannot resume, stages was'):
        training(tmp_path, STAGES_IN_MINIATURE[:1]).restore()


def test_stages_grow_harder_and_take_less_than_an_hour_of_updates() -> None:
    assert [stage.name for stage in STAGES] == ['walk', 'robust', 'mazes']
    updates = humanoid.UPDATES_PER_SWEEP * sum(stage.sweeps for stage in STAGES)
    assert updates / 80 < 3600  # at 80 a second
