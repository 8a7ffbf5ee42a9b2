"""The example packages install and do what they show."""

import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys

import numpy as np
from PIL import Image
import pytest

from tests import programs

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope='module')
def guests(tmp_path_factory) -> Path:
    """A folder with the example's package installed, built from a copy."""
    folder = tmp_path_factory.mktemp('example')
    shutil.copytree(ROOT / 'examples' / 'custom_agent', folder / 'source')
    target = ['--target', str(folder / 'installed'), str(folder / 'source')]
    options = ['-q', '--no-deps', '--no-build-isolation', '--no-index']
    subprocess.run([sys.executable, '-m', 'pip', 'install', *options, *target], check=True)
    return folder / 'installed'


def metagcttt(arguments: list[str], folder: Path, guests: Path) -> programs.Ended:
    return programs.metagcttt(arguments, folder, {**os.environ, 'PYTHONPATH': str(guests)})


def test_agent_of_another_package_trains_with_its_settings_and_adapts(tmp_path, guests) -> None:
    rng = np.random.default_rng(0)
    np.savez(
        tmp_path / 'mine.npz',
        observations=rng.uniform(0, 8, (300, 2)).astype(np.float32),
        actions=rng.uniform(-1, 1, (300, 2)).astype(np.float32),
        terminals=np.arange(300) % 100 == 99,
    )
    data = ['--dataset', 'mine.npz']
    flags = ['--agent', 'huber', '--huber.delta', '0.5', '--hidden', '8', '--training.steps', '2']
    run = metagcttt(['pretrain', *data, *flags, '--out', 'base'], tmp_path, guests)
    assert run.returncode == 0, run.output
    index = json.loads((tmp_path / 'base' / 'checkpoint' / 'checkpoint.json').read_text())
    assert index['agent'] == 'huber'
    assert index['settings']['delta'] == 0.5
    more = ['pretrain', '--out', 'base', '--resume', '--training.steps', '3']
    run = metagcttt(more, tmp_path, guests)
    assert run.returncode == 0, run.output
    policy = ['--checkpoint', 'base/checkpoint', '--out', 'meta']
    steps = ['--meta.outer-steps', '1', '--meta.inner-steps', '1']
    run = metagcttt(['meta-train', *data, *policy, *steps], tmp_path, guests)
    assert run.returncode == 0, run.output


def test_help_offers_the_agent_and_its_settings(tmp_path, guests) -> None:
    text = metagcttt(['pretrain', '--help'], tmp_path, guests).output
    assert '--agent {crl,gcbc,gciql,saw,huber}' in text
    assert '--huber.delta' in text


def test_misspelt_agent_is_refused_with_the_known_ones(tmp_path, guests) -> None:
    (tmp_path / 'mine.yaml').write_text('pretrain: {agent: hubert}')
    run = metagcttt(['pretrain', '--preset', 'mine.yaml'], tmp_path, guests)
    assert run.returncode == 2
    assert "unknown agent 'hubert'; did you mean 'huber'?" in run.output
    run = metagcttt(['pretrain', '--agent', 'hubert'], tmp_path, guests)
    assert run.returncode == 2
    assert 'huber' in run.output


SCRIPTS = {
    'adapt.py': (),
    'own_data.py': (),
    'policy_loop.py': (),
    'animate_adaptation.py': ('out/adaptation.gif',),
}


@pytest.mark.slow
@pytest.mark.parametrize('name', SCRIPTS)
def test_example_does_what_it_shows(name: str, tmp_path: Path) -> None:
    (tmp_path / 'assets').symlink_to(ROOT / 'assets')
    run = subprocess.run(
        [sys.executable, str(ROOT / 'examples' / name), *SCRIPTS[name]],
        cwd=tmp_path,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(map(str, (ROOT, ROOT / 'tools')))},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    numbers = [float(number) for number in re.findall(r'\d+\.\d+', run.stdout)]
    if name == 'adapt.py':
        assert numbers[1] < numbers[0]
    if name == 'own_data.py':
        base, _, adapted = numbers
        assert adapted < 1 < base
    if name == 'policy_loop.py':
        assert run.stdout.count('reached') >= 4
    if name == 'animate_adaptation.py':
        with Image.open(tmp_path / 'out' / 'adaptation.gif') as film:
            assert film.n_frames > 10


def test_examples_are_of_a_page() -> None:
    for script in (ROOT / 'examples').glob('*.py'):
        assert len(script.read_text().splitlines()) <= 60, script
        assert script.name in SCRIPTS or script.name == 'ros_client.py'  # tests/ros runs that
