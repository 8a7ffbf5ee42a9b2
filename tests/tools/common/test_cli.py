"""Command lines: defaults, then a preset, then flags; every wrong value ends with status 2."""

from collections.abc import Iterator
import importlib
from importlib.metadata import version
import json
import re
import subprocess
import sys
from typing import get_args

from metagcttt_core.config import Settings
from metagcttt_tools.common.cli import fail, parse, preset_values
from metagcttt_tools.common.presets import load_preset, preset_names
from metagcttt_tools.main import main, Program, PROGRAMS
from pydantic import BaseModel, Field, ValidationError
import pytest


class Inner(Settings):
    rate: float = Field(0.5, gt=0, description='how fast')
    dims: tuple[int, ...] = Field((0, 1), min_length=1, description='which')


class Toy(Settings):
    steps: int = Field(10, ge=1, description='how often')
    name: str | None = Field(None, description='what')
    fast: bool = Field(False, description='how')
    inner: Inner = Inner()


DESCRIPTION = 'A toy.\n\nExample: metagcttt toy --steps 3'


def parse_toy(*arguments: str) -> Toy:
    return parse(Toy, DESCRIPTION, 'toy', arguments)


def refused(capsys, *arguments: str) -> str:
    """What is printed when the arguments end the process with status 2."""
    with pytest.raises(SystemExit) as ended:
        parse_toy(*arguments)
    assert ended.value.code == 2
    printed = capsys.readouterr()
    return ' '.join((printed.out + printed.err).replace('│', ' ').split())


@pytest.fixture
def preset(tmp_path):
    """Writes a preset file and returns its path."""

    def write(content: str) -> str:
        path = tmp_path / 'mine.yaml'
        path.write_text(content)
        return str(path)

    return write


def test_no_arguments_give_the_defaults():
    assert parse_toy() == Toy()


def test_flags_override_defaults():
    settings = parse_toy(
        '--steps', '3', '--inner.rate', '2', '--inner.dims', '2', '0', '--name', 'x', '--fast'
    )
    assert settings == Toy(steps=3, name='x', fast=True, inner=Inner(rate=2, dims=(2, 0)))


def test_preset_overrides_defaults_and_flags_override_the_preset(preset):
    path = preset('toy:\n  steps: 5\n  inner: {rate: 0.25}\nother:\n  unknown: 1\n')
    expected = Toy(steps=5, inner=Inner(rate=0.25))
    assert parse_toy('--preset', path) == expected
    assert parse_toy(f'--preset={path}') == expected
    settings = parse_toy('--steps', '7', '--preset', path, '--inner.dims', '3')
    assert settings == Toy(steps=7, inner=Inner(rate=0.25, dims=(3,)))


def test_overrides_come_between_the_preset_and_the_flags(preset, tmp_path, monkeypatch):
    path = preset('toy:\n  steps: 5\n  inner: {rate: 0.25, dims: [3]}\n')
    overrides = tmp_path / 'overrides.yaml'
    overrides.write_text('toy: {steps: 2, inner: {dims: [4]}}\nother: {}\n')
    monkeypatch.setenv('METAGCTTT_OVERRIDES', str(overrides))
    assert parse_toy('--preset', path) == Toy(steps=2, inner=Inner(rate=0.25, dims=(4,)))
    assert parse_toy('--steps', '7').steps == 7
    overrides.write_text('other: {}\n')
    assert parse_toy('--preset', path).steps == 5


def test_arguments_of_the_process_are_the_default(monkeypatch):
    monkeypatch.setattr('sys.argv', ['toy', '--steps', '4'])
    assert parse(Toy, DESCRIPTION, 'toy').steps == 4


def test_help_teaches(capsys):
    with pytest.raises(SystemExit) as ended:
        parse_toy('--help')
    assert ended.value.code == 0
    text = capsys.readouterr().out
    for part in ('A toy.', 'Example: metagcttt toy', '--steps', 'how often', 'default: 10'):
        assert part in text


@pytest.mark.parametrize(
    ('arguments', 'parts'),
    [
        (['--steps', '0'], ['steps', 'greater than or equal to 1', '0']),
        (['--inner.rate', '-1'], ['inner', 'rate', 'greater than 0', '-1']),
        (['--steps', 'many'], ['--steps', "'many'"]),
        (['--stps', '3'], ['--stps', '--steps']),
        (['--inner.dims'], ['dims', 'at least 1']),
        (['stray'], ['stray']),
        (['--preset'], ['--preset']),
    ],
)
def test_wrong_flag_is_refused_by_name(arguments, parts, capsys):
    text = refused(capsys, *arguments)
    assert all(part in text for part in parts), text


@pytest.mark.parametrize(
    ('content', 'lines'),
    [
        ('toy: {stps: 5}', ["Toy has no setting 'stps'; did you mean 'steps'?"]),
        ('toy: {inner: {raet: 5}}', ["inner: Inner has no setting 'raet'; did you mean 'rate'?"]),
        (
            'toy: {steps: 0, inner: {rate: -2}}',
            [
                'mine.yaml: steps: Input should be greater than or equal to 1, got 0',
                'mine.yaml: inner.rate: Input should be greater than 0, got -2',
            ],
        ),
        ('other: {}', ["has no section 'toy'; it has: other"]),
        ('toy: 5', ['toy must hold a mapping of settings, got int']),
        ('toy:', ['toy must hold a mapping of settings, got NoneType']),
        ('toy: {5: 3}', ['Toy has no setting 5']),
        ('toy: [1', ['not valid YAML']),
    ],
)
def test_wrong_preset_is_refused_by_name(content, lines, preset, capsys):
    text = refused(capsys, '--preset', preset(content))
    assert text.startswith('error: ')
    assert all(line in text for line in lines), text


def test_misspelt_section_is_refused_with_the_nearest_known_one(preset, monkeypatch, capsys):
    path = preset('meta_trian: {meta: {outer_steps: 3}}')
    for arguments in (['--preset', path], [f'--preset={path}'], []):
        with pytest.raises(SystemExit):
            main(['meta-train', *arguments])
        error = capsys.readouterr().err
        assert f"{path}: 'meta_trian' is a section of no program; did you mean 'meta_train'?" in (
            error
        )
        monkeypatch.setenv('METAGCTTT_OVERRIDES', path)  # from the second time on


def test_unknown_preset_is_refused_with_the_nearest_known_one(capsys):
    text = refused(capsys, '--preset', 'pointmaze-medium-stitch-studi')
    assert "did you mean 'pointmaze-medium-stitch-study'?" in text
    assert 'preset file /absent/mine.yaml does not exist' in refused(
        capsys, '--preset', '/absent/mine.yaml'
    )


def test_failing_prints_each_line_to_standard_error(capsys):
    with pytest.raises(SystemExit) as ended:
        fail('first', 'second')
    assert ended.value.code == 2
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ('', 'error: first\nerror: second\n')


def test_no_preset_gives_no_values():
    assert preset_values(None, 'toy') == {}


def programs() -> dict[str, Program]:
    """Every program by its subcommand."""
    found = {}
    for name, program in PROGRAMS.items():
        inner = {'': program} if isinstance(program, Program) else program.programs
        found |= {f'{name} {key}'.strip(): value for key, value in inner.items()}
    return found


class Parsed(Exception):
    """Ends a program right after it has asked for its settings."""


def asked_settings(name: str, monkeypatch) -> tuple[type[Settings], str, str, str]:
    """The model, description, name and preset section that a program parses with."""
    module = importlib.import_module(f'metagcttt_tools.{programs()[name].module}')

    def stop(model, description, program, argv=None, *, section=None):
        raise Parsed(model, description, program, section or program.replace('-', '_'))

    monkeypatch.setattr(module, 'parse', stop)
    with pytest.raises(Parsed) as asked:
        module.main([])
    return asked.value.args


@pytest.mark.parametrize('name', programs())
def test_every_program_teaches_and_reads_the_section_of_its_name(name, monkeypatch):
    model, description, program, section = asked_settings(name, monkeypatch)
    assert program == name
    assert section == name.removesuffix('-ros').replace('-', '_')  # it is the same evaluation
    assert f'metagcttt {name}' in description
    for field, info in model.model_fields.items():
        nested = isinstance(info.annotation, type) and issubclass(info.annotation, Settings)
        assert info.description or nested, f'{field} has no description'


def nested_models(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    yield model
    for field in model.model_fields.values():
        for part in (field.annotation, *get_args(field.annotation)):
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from nested_models(part)


@pytest.mark.parametrize('name', programs())
def test_misspelt_setting_of_any_depth_is_refused_with_the_nearest_known_one(name, monkeypatch):
    for model in nested_models(asked_settings(name, monkeypatch)[0]):
        for field in model.model_fields:
            wrong = f'{field}z'
            with pytest.raises(ValidationError, match=rf"'{wrong}'; did you mean '{field}'"):
                model.model_validate({wrong: 1})


@pytest.mark.parametrize('preset_name', preset_names())
def test_every_section_of_every_preset_fits_its_program(preset_name, monkeypatch):
    names = {re.sub(r'\W', '_', name): name for name in programs()}
    for section, values in load_preset(preset_name).items():
        model, *_ = asked_settings(names[section], monkeypatch)
        settings = model.model_validate(values)
        given = settings.model_dump(mode='json', exclude_unset=True)
        assert given.keys() == values.keys()


@pytest.mark.parametrize(
    ('name', 'listed', 'unlisted'),
    [
        ('generate', 'antmaze-medium-navigate-study', 'paper-'),
        ('pack-assets', 'pointmaze-medium-navigate-cpu', 'study'),
        ('presets', '', '--preset NAME_OR_PATH'),
    ],
)
def test_help_offers_the_presets_that_the_program_can_run(name, listed, unlisted, capsys):
    with pytest.raises(SystemExit, match='0'):
        main([name, '--help'])
    text = capsys.readouterr().out
    assert text.startswith(f'usage: metagcttt {name} ')
    assert listed in text
    assert unlisted not in text


def test_help_lists_every_program(capsys):
    with pytest.raises(SystemExit, match='0'):
        main(['--help'])
    text = ' '.join(capsys.readouterr().out.replace('│', ' ').split())
    for name, program in PROGRAMS.items():
        assert name in text
        assert program.summary in text
    with pytest.raises(SystemExit, match='0'):
        main(['controller', '--help'])
    text = capsys.readouterr().out
    assert 'usage: metagcttt controller' in text
    assert 'train' in text


def test_unknown_program_is_refused_with_the_known_ones(capsys):
    with pytest.raises(SystemExit, match='2'):
        main(['pretrian'])
    text = capsys.readouterr().err
    assert 'pretrian' in text
    assert 'pretrain' in text


def test_version_is_that_of_the_package(capsys):
    main(['--version'])
    assert capsys.readouterr().out == f'metagcttt {version("metagcttt-core")}\n'


HEAVY = ('torch', 'mujoco', 'ogbench', 'gymnasium', 'matplotlib', 'tensorboard', 'rclpy', 'h5py')


ALL_HELP = """
import contextlib, io, json, sys
from metagcttt_tools.main import main
names, heavy = json.loads(sys.argv[1])
for name in names:
    with contextlib.redirect_stdout(io.StringIO()) as shown, contextlib.suppress(SystemExit):
        main([*name.split(), '--help'])
    assert 'usage: metagcttt' in shown.getvalue(), name
    assert not (found := [module for module in heavy if module in sys.modules]), (name, found)
"""


def test_help_imports_nothing_heavy():
    """What takes a second to import waits until it is used."""
    names = json.dumps([['', *programs()], HEAVY])
    command = [sys.executable, '-c', ALL_HELP, names]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
