"""The data generator's command line."""

import json
import os
from pathlib import Path
import subprocess
import sys

from metagcttt_core.data import TrajectoryDataset
from metagcttt_tools import generate
import pytest
import sim_bridge

pytestmark = pytest.mark.mujoco
ROOT = Path(sim_bridge.__file__).parents[1]
SMALL = ['--episodes', '12', '--rows-per-episode', '51', '--processes', '1']


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_default_output_is_named_as_ogbench_names_it(capsys: pytest.CaptureFixture[str]) -> None:
    generate.main(['--kind', 'stitch', *SMALL])
    written = sorted(str(path) for path in Path('data').iterdir() if path.suffix != '.lock')
    assert written == [
        'data/pointmaze-medium-stitch-v0-val.npz',
        'data/pointmaze-medium-stitch-v0.json',
        'data/pointmaze-medium-stitch-v0.npz',
        'data/pointmaze-medium-stitch-v0.png',
    ]
    dataset = TrajectoryDataset.load('data/pointmaze-medium-stitch-v0.npz')
    assert (dataset.num_episodes, dataset.num_rows) == (12, 612)
    out = capsys.readouterr().out
    assert 'episodes  12 + 1 for validation' in out
    assert 'rows      612 + 51' in out
    for label in ('goals', 'falls', 'coverage', 'picture', 'seconds'):
        assert label in out


@pytest.mark.parametrize(
    ('standing', 'name'),
    [
        (False, 'humanoidmaze-medium-stitch-v0'),
        (True, 'humanoidmaze-medium-stitch-standing-v0'),
    ],
)
def test_data_of_a_humanoid_say_how_it_starts(standing: bool, name: str) -> None:
    settings = generate.GenerateSettings(
        environment='humanoidmaze-medium-v0', kind='stitch', standing=standing
    )
    assert settings.file == Path(f'data/{name}.npz')


def test_flags_reach_the_plan() -> None:
    generate.main(
        '--environment pointmaze-large-v0 --kind explore --seed 9 --noise 0.25 --output a/b.npz'
        ' --episodes 3 --rows-per-episode 11 --processes 1'.split()
    )
    sidecar = json.loads(Path('a/b.json').read_text())
    assert sidecar['environment'] == 'pointmaze-large-v0'
    assert (sidecar['kind'], sidecar['seed'], sidecar['noise']) == ('explore', 9, 0.25)


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--environment', 'pointmaze-mediun-v0'], "did you mean 'pointmaze-medium-v0'"),
        (
            ['--environment', 'humanoidmaze-medium-v0', '--controller', 'nowhere'],
            'nowhere: no direction controller there',
        ),
        (
            [
                '--environment',
                'humanoidmaze-medium-v0',
                '--standing',
                '--output',
                'humanoidmaze-medium-navigate-v0.npz',
            ],
            "humanoidmaze-medium-navigate-v0.npz: is the name of OGBench's data",
        ),
        (['--standing'], 'only humanoids have a standing start'),
        (['--output', 'here.zip'], 'must end in .npz, got here.zip'),
        (['--kind', 'play'], 'play'),
        (['--episodes', '0'], 'episodes'),
    ],
)
def test_bad_request_ends_with_status_2_and_says_why(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        generate.main([*SMALL, *arguments])
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert message in captured.out + captured.err
    assert [path for path in Path('data').glob('*') if path.suffix != '.lock'] == []


def test_existing_dataset_is_replaced_only_when_told(capsys: pytest.CaptureFixture[str]) -> None:
    generate.main(SMALL)
    with pytest.raises(SystemExit):
        generate.main(SMALL)
    assert 'overwrite' in capsys.readouterr().err
    generate.main([*SMALL, '--resume'])
    generate.main([*SMALL, '--overwrite', '--seed', '1'])
    assert json.loads(Path('data/pointmaze-medium-navigate-v0.json').read_text())['seed'] == 1


def test_help_teaches_with_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        generate.main(['--help'])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert 'metagcttt generate --environment pointmaze-medium-v0' in text
    for flag in ('--kind', '--episodes', '--seed', '--processes', '--resume', '--output'):
        assert flag in text


def test_ctrl_c_ends_with_status_130_and_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(generate, 'generate', interrupt)
    with pytest.raises(SystemExit) as stop:
        generate.main(SMALL)
    assert stop.value.code == 130
    assert 'pass --resume to continue' in capsys.readouterr().err


def test_runs_as_a_module() -> None:
    command = [sys.executable, '-m', 'metagcttt_tools', 'generate', *SMALL, '--output', 'maze.npz']
    done = subprocess.run(
        command,
        env={**os.environ, 'PYTHONPATH': str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert Path('maze-val.npz').exists()
