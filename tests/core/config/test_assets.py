"""Where the committed assets are found."""

from pathlib import Path

from metagcttt_core.config import assets_dir
from metagcttt_core.config.assets import checkpoint_path, dataset_path
import pytest


def test_environment_variable_names_the_folder(tmp_path, monkeypatch):
    monkeypatch.setenv('METAGCTTT_ASSETS', str(tmp_path))
    assert assets_dir() == tmp_path


def test_missing_folder_is_refused_with_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv('METAGCTTT_ASSETS', str(tmp_path / 'absent'))
    message = rf'no assets folder at {tmp_path}/absent: install .* or set METAGCTTT_ASSETS'
    with pytest.raises(FileNotFoundError, match=message):
        assets_dir()


@pytest.mark.parametrize('value', [None, ''])
def test_assets_of_the_checkout_are_the_default(value, monkeypatch, request):
    if value is None:
        monkeypatch.delenv('METAGCTTT_ASSETS', raising=False)
    else:
        monkeypatch.setenv('METAGCTTT_ASSETS', value)
    expected = request.config.rootpath / 'assets'
    if expected.is_dir():
        assert assets_dir() == expected
    else:
        with pytest.raises(FileNotFoundError, match=str(expected)):
            assets_dir()


def test_empty_path_names_the_committed_files(tmp_path, monkeypatch):
    monkeypatch.setenv('METAGCTTT_ASSETS', str(tmp_path))
    monkeypatch.setenv('HOME', '/home/someone')
    folder = tmp_path / 'pointmaze-medium-navigate'
    assert checkpoint_path('') == folder / 'meta'
    assert dataset_path('') == folder / 'dataset.npz'
    assert checkpoint_path('~/policy') == Path('/home/someone/policy')
    assert dataset_path('data.npz') == Path('data.npz')
