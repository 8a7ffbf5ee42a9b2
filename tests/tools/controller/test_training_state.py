"""States of trainings are whole, of the same settings, or refused by name."""

from pathlib import Path

from metagcttt_tools.controller.training_state import read_training_state, write_training_state
import numpy as np
import pytest
import safetensors.torch
import torch

SETTINGS = {'seed': 3, 'sac': {'lr': 1e-3}}
TENSORS = {
    'actor.weights': torch.arange(60, dtype=torch.float32).reshape(5, 12),
    'replay.masks': torch.tensor([True, False]),
    'sweep': torch.tensor(7),
}


def test_state_comes_back_with_the_same_bits(tmp_path: Path) -> None:
    write_training_state(tmp_path / 'state', SETTINGS, TENSORS)
    read = read_training_state(tmp_path / 'state', SETTINGS)
    assert read.keys() == TENSORS.keys()
    for name, tensor in TENSORS.items():
        assert read[name].dtype == tensor.dtype
        assert torch.equal(read[name], tensor)


def test_other_settings_are_refused_by_name(tmp_path: Path) -> None:
    write_training_state(tmp_path / 'state', SETTINGS, TENSORS)
    with pytest.raises(ValueError, match='state: cannot resume, seed was 3 and is now 4'):
        read_training_state(tmp_path / 'state', {**SETTINGS, 'seed': 4})


def test_any_damage_is_noticed(tmp_path: Path) -> None:
    write_training_state(tmp_path / 'state', SETTINGS, TENSORS)
    whole = (tmp_path / 'state').read_bytes()
    rng = np.random.default_rng(0)
    damaged = tmp_path / 'damaged'
    for _ in range(300):
        content = bytearray(whole)
        place = int(rng.integers(len(content)))
        if rng.random() < 0.3:
            del content[place:]
        else:
            content[place] ^= 1 << int(rng.integers(8))
        damaged.write_bytes(content)
        try:
            read = read_training_state(damaged, SETTINGS)
        except ValueError as error:
            assert str(damaged) in str(error)
        else:  # what is damaged means nothing, such as a blank in the header
            assert all(torch.equal(read[name], tensor) for name, tensor in TENSORS.items())


@pytest.mark.parametrize('content', [b'', b'controller', safetensors.torch.save(TENSORS)])
def test_file_that_is_no_state_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / 'state').write_bytes(content)
    with pytest.raises(ValueError, match=r'state: (cannot be read|is damaged)'):
        read_training_state(tmp_path / 'state', SETTINGS)


def test_folder_in_its_place_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match='cannot be read'):
        read_training_state(tmp_path, SETTINGS)
