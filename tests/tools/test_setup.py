from collections.abc import Callable, Iterator
import fcntl
from importlib.metadata import distribution, PackageNotFoundError
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
import pytest

ROOT = Path(__file__).parents[2]
NEEDED = (
    *('bash', 'cat', 'cut', 'dirname', 'find', 'flock', 'grep', 'ln', 'mkdir', 'rm', 'sha256sum'),
    *('sort', 'tail', 'tee', 'timeout', 'touch', 'uname', 'xargs', 'make', 'cmake', 'c++'),
)
PYTHONS = ('python3.11', 'python3.12', 'python3.13', 'python3')


class Machine:
    """A copy of the set-up script and a PATH with chosen tools."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / 'checkout'
        self.path = folder / 'bin'
        (self.root / 'tools').mkdir(parents=True)
        (self.root / 'ros2_ws' / 'src').mkdir(parents=True)
        self.path.mkdir()
        for name in (
            'constraints.txt',
            'pyproject.toml',
            'tools/setup.sh',
            'tools/packages.sh',
            'tools/fix_ros_wheels.py',
        ):
            shutil.copy(ROOT / name, self.root / name)
        for tool in NEEDED:
            (self.path / tool).symlink_to(shutil.which(tool))

    def tool(self, name: str, script: str) -> None:
        """Put a program on the PATH, never through a link into the machine's own."""
        (self.path / name).unlink(missing_ok=True)
        (self.path / name).write_text(f'#!/bin/bash\n{script}\n')
        (self.path / name).chmod(0o755)

    def start(self, **environment: str) -> subprocess.Popen:
        """Run the set-up."""
        return subprocess.Popen(
            [str(self.root / 'tools' / 'setup.sh')],
            env={'PATH': str(self.path), 'HOME': os.environ.get('HOME', '/'), **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def complaint(self, **environment: str) -> str:
        """What the set-up fails with."""
        process = self.start(**environment)
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 1
        return errors


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


@pytest.mark.parametrize(
    ('tool', 'message'),
    [
        ('cmake', 'cmake is missing: install it (Debian, Ubuntu: apt install cmake)'),
        ('make', 'make is missing: install it (Debian, Ubuntu: apt install make)'),
        ('c++', 'a C++ compiler (c++) is missing: install it (Debian, Ubuntu: apt install g++)'),
        ('flock', 'flock is missing: install it (Debian, Ubuntu: apt install util-linux)'),
    ],
)
def test_missing_tool_ends_the_setup_with_one_line(
    machine: Machine, tool: str, message: str
) -> None:
    (machine.path / tool).unlink()
    assert machine.complaint() == f'setup: {message}\n'


def test_compiler_named_by_cxx_counts(machine: Machine) -> None:
    assert 'a C++ compiler (nosuch++) is missing' in machine.complaint(CXX='nosuch++')


def test_no_python_ends_the_setup_with_one_line(machine: Machine) -> None:
    errors = machine.complaint()
    assert errors.startswith('setup: no suitable Python: install Python 3.11, 3.12 or 3.13')
    assert errors.count('\n') == 1


def test_every_unsuitable_python_is_named_with_its_fault(machine: Machine) -> None:
    machine.tool('python3.11', 'exit 127')  # what a version manager leaves behind
    python = f'exec "{sys.executable}" -c "import sys; sys.version_info = (3, 10, 0)'
    old = f'[ "$1" = -c ] && exit 0\n{python}; exec(open(0).read())" "${{@:2}}"'
    machine.tool('python3', old)
    errors = machine.complaint()
    assert '(python3.11 does not run; python3 is version 3.10)' in errors
    assert errors.count('\n') == 1


def test_another_ros_is_refused(machine: Machine) -> None:
    assert machine.complaint(ROS_DISTRO='humble') == (
        'setup: ROS 2 humble is sourced, Jazzy is needed: source Jazzy, '
        'or use a shell without ROS\n'
    )


@pytest.fixture
def hold_lock(machine: Machine) -> Iterator[Callable[[], None]]:
    with (machine.root / '.setup.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield lambda: fcntl.flock(lock, fcntl.LOCK_UN)


def test_second_setup_waits_for_the_first(machine: Machine, hold_lock) -> None:
    process = machine.start()
    assert process.stdout.readline() == 'setup: another set-up is running; waiting for it\n'
    assert process.poll() is None
    hold_lock()
    assert 'no suitable Python' in process.communicate(timeout=60)[1]


# Stands for Python: writes down what pip is asked for, and builds a workspace in four steps.
PYTHON = r"""
case "$*" in
  *'-m venv'*) mkdir -p "$3/bin" && cat "$0" >"$3/bin/python" && chmod +x "$3/bin/python" ;;
  *--dry-run*) echo "Would install torch-2.13.0 ${PLAN:-sympy-1.14.0}" ;;
  *-m\ pip*) echo "$*" >>"$HOME/pip"
    [[ $* != *' -e '* ]] || printf '%s\n' Collecting\ {1..60} 'Installing collected packages: 1' ;;
  *urlopen*) exit "${NO_ANSWER:-0}" ;;
  *'version_info < (3, 13)'*) exit "${BEFORE_3_13:-0}" ;;
  *purelib*) echo "$HOME" ;;
  *'-m colcon'*) printf '%s\n' 'Starting >>> a' '[  5%] x' '[ 10%] y' '[ 10%] z'
    echo 'Finished <<< a' ;;
esac"""
CPU_BUILDS = 'install --no-deps --index-url https://download.pytorch.org/whl/cpu'


@pytest.fixture
def set_up(machine: Machine, tmp_path: Path) -> Callable[..., tuple[str, str]]:
    """Runs the set-up to its end; returns what it printed and what pip was asked for."""

    def run(**environment: str) -> tuple[str, str]:
        machine.tool('python3.11', PYTHON)
        machine.tool('chmod', f'exec {shutil.which("chmod")} "$@"')
        process = machine.start(HOME=str(tmp_path), **environment)
        printed, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
        return printed, (tmp_path / 'pip').read_text()

    return run


needs_no_gpu = pytest.mark.skipif(
    any(Path(device).exists() for device in ('/dev/nvidiactl', '/dev/dxg')),
    reason='the machine has an NVIDIA GPU, for which set-up takes other packages',
)


def test_every_stage_says_that_it_begins_and_how_far_it_is(set_up) -> None:
    printed, _ = set_up()
    stages = [line for line in printed.splitlines() if ' of 4: ' in line]
    assert [line[:14] for line in stages] == [f'setup: {n} of 4:' for n in (1, 2, 3, 4)]
    assert f'{len(pins())} are pinned' in stages[2]
    assert printed.count('Collecting') == 0
    assert ['setup:   50 found', 'setup:   installing them'] == printed.splitlines()[3:5]
    progress = ['setup:   Starting >>> a', 'setup:   10%', 'setup:   Finished <<< a']
    assert printed.splitlines()[-3:] == progress


@needs_no_gpu
def test_pytorch_comes_without_cuda_where_there_is_no_gpu(set_up) -> None:
    _, asked = set_up()
    first, second = [line for line in asked.splitlines() if 'setuptools' not in line][:2]
    assert CPU_BUILDS in first
    assert first.endswith('torch')
    assert '-e ' in second


@needs_no_gpu
def test_set_up_goes_on_without_the_index_of_cpu_builds(set_up) -> None:
    printed, asked = set_up(NO_ANSWER='1')
    assert 'no answer from https://download.pytorch.org/whl/cpu' in printed
    assert '--index-url' not in asked


@needs_no_gpu
@pytest.mark.parametrize('cuda', ['nvidia-cublas-13.1.0.3', 'cuda-bindings-13.0.3'])
def test_cuda_comes_without_a_gpu_only_on_request(
    cuda: str, machine: Machine, set_up, tmp_path: Path
) -> None:
    with pytest.raises(AssertionError, match=r'only with gigabytes of CUDA.*METAGCTTT_CUDA=1'):
        set_up(NO_ANSWER='1', PLAN=cuda)
    assert '-e ' not in (tmp_path / 'pip').read_text()
    _, asked = set_up(NO_ANSWER='1', PLAN=cuda, METAGCTTT_CUDA='1')
    assert '-e ' in asked


def test_gpu_gets_the_build_with_cuda(machine: Machine, set_up) -> None:
    machine.tool('nvidia-smi', 'exit 0')
    printed, asked = set_up()
    assert 'PyTorch comes with CUDA' in printed
    assert '--index-url' not in asked


@pytest.mark.parametrize(('before', 'alone'), [('0', True), ('1', False)])
def test_ogbench_comes_alone_from_python_3_13_on(before: str, alone: bool, set_up) -> None:
    _, asked = set_up(BEFORE_3_13=before)
    assert ('--no-deps -c' in asked and 'ogbench' in asked) == alone


def pins() -> dict[str, str]:
    lines = (ROOT / 'constraints.txt').read_text().splitlines()
    pairs = (line.split('==') for line in lines if line and not line.startswith('#'))
    return {canonicalize_name(name): version for name, version in pairs}


def requirements(name: str, extras: frozenset[str]) -> Iterator[Requirement]:
    """What an installed distribution with these extras needs in this environment."""
    for text in distribution(name).requires or ():
        requirement = Requirement(text)
        environments = [{'extra': extra} for extra in extras or ('',)]
        marker = requirement.marker
        if marker is None or any(marker.evaluate(environment) for environment in environments):
            yield requirement


def test_constraints_pin_all_that_is_installed() -> None:
    extras = {'dev', 'workspace'} | (set() if 'ROS_DISTRO' in os.environ else {'ros', 'ros-build'})
    waiting = [('metagcttt-core', frozenset(extras))]
    seen, loose = set(waiting), []
    while waiting:
        for requirement in requirements(*waiting.pop()):
            name, wanted = canonicalize_name(requirement.name), frozenset(requirement.extras)
            try:
                version = distribution(name).version.split('+')[0]
            except PackageNotFoundError:
                loose.append(f'{name} is needed and not installed')
                continue
            # PyTorch's GPU builds pin their own libraries.
            pinned = name == 'metagcttt-core' or pins().get(name) == version
            if not pinned and not re.match('nvidia-|triton|cuda-', name):
                loose.append(f'{name} is {version}, pinned to {pins().get(name)}')
            if (name, wanted) not in seen:
                seen.add((name, wanted))
                waiting.append((name, wanted))
    assert loose == []
