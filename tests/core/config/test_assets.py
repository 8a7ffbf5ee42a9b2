"""Where the committed assets are found."""

from metagcttt_core.config import assets_dir
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
