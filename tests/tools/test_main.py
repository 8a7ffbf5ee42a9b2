"""The command as it is installed: without the extras, too."""

from importlib.metadata import packages_distributions
import json
from pathlib import Path
import shlex
import shutil
import subprocess
import sys
import tomllib

from metagcttt_tools.common import run_log
from metagcttt_tools.common.extras import EXTRAS
from metagcttt_tools.main import main
from packaging.requirements import Requirement
import pytest

PROJECT = tomllib.loads((Path(__file__).parents[2] / 'pyproject.toml').read_text())['project']


@pytest.mark.parametrize(
    ('module', 'program', 'line'),
    [
        (
            'matplotlib',
            'draw-episodes',
            'this takes matplotlib, which is not installed: pip install "metagcttt-core[plots]"',
        ),
        (
            'ogbench',
            'download',
            'this takes ogbench, which is not installed: pip install '
            + ('"metagcttt-core[mazes]"' if sys.version_info < (3, 13) else '--no-deps ogbench'),
        ),
        ('rclpy', 'demo', 'this takes ROS 2 and the workspace (rclpy is missing): make setup'),
    ],
)
def test_missing_package_is_one_line_with_its_command(
    module: str, program: str, line: str
) -> None:
    script = f'import sys; sys.modules[{module!r}] = None; from metagcttt_tools.main import main'
    result = subprocess.run(
        [sys.executable, '-c', f'{script}; main([{program!r}])'], capture_output=True, text=True
    )
    assert result.returncode == 2
    assert result.stderr == f'error: {line}\n'


def test_fault_of_our_own_is_not_taken_for_a_missing_extra(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, 'metagcttt_tools.pretrain', None)
    with pytest.raises(ModuleNotFoundError):
        main(['pretrain'])


def test_extras_bring_the_packages_they_are_named_for() -> None:
    distributions = packages_distributions()
    for module, extra in EXTRAS.items():
        listed = PROJECT['optional-dependencies'][extra]
        assert set(distributions[module]) & {Requirement(text).name for text in listed}
        assert not set(distributions[module]) & set(PROJECT['dependencies'])


def test_every_optional_package_is_known_to_the_command() -> None:
    extras = PROJECT['optional-dependencies']
    distributions = packages_distributions()
    known = {name for module in EXTRAS for name in distributions[module]}
    for extra in set(EXTRAS.values()):
        assert {Requirement(text).name for text in extras[extra]} <= known
    most = sorted(set(EXTRAS.values()) - {'cluster'})  # Ray takes half a gigabyte
    assert extras['all'] == [f'metagcttt-core[{",".join(most)}]']


def test_run_is_logged_to_its_file_without_tensorboard(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(run_log, 'find_spec', lambda name: None)
    with run_log.RunLog(tmp_path, 0) as log:
        log.write(1, {'loss': 0.5}, samples={'k': [1.0]}, warnings=['looks bad'])
    assert [path.name for path in tmp_path.iterdir()] == ['metrics.jsonl']
    assert json.loads((tmp_path / 'metrics.jsonl').read_text())['loss'] == 0.5
    told = 'no TensorBoard logs: pip install "metagcttt-core[plots]"\n'
    assert capsys.readouterr().err == told


@pytest.fixture(scope='module')
def completion(tmp_path_factory) -> Path:
    script = tmp_path_factory.mktemp('completion') / 'metagcttt.bash'
    with pytest.raises(SystemExit):
        main(['--tyro-write-completion', 'bash', str(script)])
    return script


@pytest.mark.parametrize(
    ('typed', 'offered'),
    [
        (['metagcttt', 'meta-tr'], 'meta-train'),
        (['metagcttt', 'meta-train', '--meta.inner-s'], '--meta.inner-steps'),
        (['metagcttt', 'meta-train', '--meta.algorithm', 'fom'], 'fomaml'),
        (['metagcttt', 'pretrain', '--pres'], '--preset'),
        (['metagcttt', 'benchmark', 'sim', '--rou'], '--rounds'),
    ],
)
def test_shell_completes_programs_and_their_flags(typed, offered, completion) -> None:
    words = ' '.join(map(shlex.quote, typed))
    script = f"""source {completion}; COMP_WORDS=({words}) COMP_CWORD={len(typed) - 1}
        $(complete -p metagcttt | sed 's/.*-F \\([^ ]*\\).*/\\1/')
        printf '%s\\n' "${{COMPREPLY[@]}}" """
    shell = subprocess.run(['bash', '-c', script], capture_output=True, text=True)
    assert shell.stdout.split() == [offered], shell.stderr


@pytest.mark.parametrize('shell', ['bash', 'zsh', 'tcsh', 'fish'])
def test_every_shell_gets_a_script_with_the_flags(shell, capsys) -> None:
    with pytest.raises(SystemExit):
        main(['--tyro-print-completion', shell])
    script = capsys.readouterr().out
    assert 'meta.outer-steps' in script
    if shutil.which(shell):
        checked = subprocess.run([shell, '-n'], input=script, capture_output=True, text=True)
        assert checked.returncode == 0, checked.stderr
