"""Presets: they load, and what is missing or malformed is refused by name."""

from metagcttt_tools.common.presets import load_preset, preset_names
import pytest


def test_every_preset_is_a_mapping_of_mappings():
    names = preset_names()
    assert 'pointmaze-medium-navigate-cpu' in names
    assert names == sorted(names)
    for name in names:
        preset = load_preset(name)
        assert preset
        assert all(isinstance(section, dict) for section in preset.values()), name


def test_loaded_preset_is_the_caller_s_own():
    load_preset('pointmaze-medium-navigate-cpu')['generate']['kind'] = 'changed'
    assert load_preset('pointmaze-medium-navigate-cpu')['generate']['kind'] == 'navigate'


@pytest.mark.parametrize('suffix', ['yaml', 'yml'])
def test_preset_file_is_loaded_by_path(suffix, tmp_path):
    path = tmp_path / f'mine.{suffix}'
    path.write_text('pretrain:\n  seed: 3\n')
    assert load_preset(path) == load_preset(str(path)) == {'pretrain': {'seed': 3}}


@pytest.mark.parametrize(
    ('name', 'message'),
    [
        ('pointmaze-medium-stitch-studi', "did you mean 'pointmaze-medium-stitch-study'"),
        ('xyz', r"no preset 'xyz' \(known: .*pointmaze-medium-navigate-cpu"),
        ('../study', r"no preset '../study'"),
        ('', "no preset ''"),
    ],
)
def test_unknown_name_is_refused_with_the_nearest_known_one(name, message):
    with pytest.raises(ValueError, match=message):
        load_preset(name)


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ('a: [1, 2', r'mine\.yaml:1: not valid YAML'),
        ('- 1\n- 2\n', r'mine\.yaml:1: must hold a mapping of settings'),
        ('', r'mine\.yaml:1: must hold a mapping of settings'),
        ('a: !!python/object/apply:os.getcwd []', r'mine\.yaml:1: not valid YAML'),
    ],
)
def test_malformed_file_is_refused(content, message, tmp_path):
    (tmp_path / 'mine.yaml').write_text(content)
    with pytest.raises(ValueError, match=message):
        load_preset(tmp_path / 'mine.yaml')


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r'preset file .*absent\.yaml does not exist'):
        load_preset(tmp_path / 'absent.yaml')
