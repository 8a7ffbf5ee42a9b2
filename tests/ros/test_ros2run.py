from importlib.metadata import distribution
import os
from pathlib import Path
import shutil
import subprocess

import pytest

ROS2RUN = Path(__file__).parents[2] / 'tools' / 'ros2run'
NODES = ', '.join(sorted(distribution('metagcttt').entry_points.names))


@pytest.fixture
def path_without_ros(tmp_path: Path) -> Path:
    """A folder for PATH with what the script needs, where `ros2` can be put or left out."""
    folder = tmp_path / 'bin'
    folder.mkdir()
    for tool in ('bash', 'dirname', 'env', 'paste', 'sed', 'sort'):
        (folder / tool).symlink_to(shutil.which(tool))
    return folder


def ros2run(path: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, 'PATH': str(path), **environment}
    return subprocess.run(
        [str(ROS2RUN), *arguments], env=environment, capture_output=True, text=True, timeout=60
    )


def add_executable(prefix: Path, package: str, name: str, script: str) -> Path:
    """A package with one executable, laid out as colcon installs it."""
    index = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True, exist_ok=True)
    (index / package).touch()
    executable = prefix / 'lib' / package / name
    executable.parent.mkdir(parents=True, exist_ok=True)
    executable.write_text(f'#!/bin/bash\n{script}\n')
    executable.chmod(0o755)
    return executable


def test_unknown_executable_lists_those_there_are(path_without_ros: Path) -> None:
    result = ros2run(path_without_ros, 'metagcttt', 'pilot')
    expected = f"ros2run: package 'metagcttt' has no executable 'pilot'; it has: {NODES}\n"
    assert (result.returncode, result.stderr) == (1, expected)


def test_unknown_package_lists_those_there_are(path_without_ros: Path) -> None:
    result = ros2run(path_without_ros, 'meta', 'policy_node', AMENT_PREFIX_PATH='')
    expected = (
        "ros2run: no package 'meta' with executables; there is: metagcttt, metagcttt_robots\n"
    )
    assert (result.returncode, result.stderr) == (1, expected)


@pytest.mark.parametrize('arguments', [(), ('metagcttt',), ('--help',)])
def test_wrong_use_is_explained(path_without_ros: Path, arguments: tuple[str, ...]) -> None:
    result = ros2run(path_without_ros, *arguments)
    assert result.returncode == 2
    assert 'usage: tools/ros2run PACKAGE EXECUTABLE [ARGUMENT...]' in result.stderr


def test_first_prefix_of_the_path_wins_and_arguments_arrive(
    path_without_ros: Path, tmp_path: Path
) -> None:
    for name in ('first', 'second'):
        add_executable(tmp_path / name, 'metagcttt', 'goal_node', f'echo {name} "$@"; exit 3')
    prefixes = f'{tmp_path / "first"}:{tmp_path / "second"}'
    result = ros2run(
        path_without_ros, 'metagcttt', 'goal_node', 'a b', '-x', AMENT_PREFIX_PATH=prefixes
    )
    assert (result.returncode, result.stdout) == (3, 'first a b -x\n')


def test_executable_replaces_the_script(path_without_ros: Path, tmp_path: Path) -> None:
    add_executable(tmp_path, 'mine', 'pid', 'echo $$')
    process = subprocess.Popen(
        [str(ROS2RUN), 'mine', 'pid'],
        env={**os.environ, 'PATH': str(path_without_ros), 'AMENT_PREFIX_PATH': str(tmp_path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert int(process.communicate(timeout=60)[0]) == process.pid


def test_environment_leads_to_the_workspace_alone(path_without_ros: Path, tmp_path: Path) -> None:
    show = 'echo "${_ROS_WHEELS_BOOTSTRAP_COMPLETE-unset} ${LD_LIBRARY_PATH-unset}"; '
    show += 'echo $AMENT_PREFIX_PATH; echo $ROS_AUTOMATIC_DISCOVERY_RANGE'
    add_executable(tmp_path, 'mine', 'show', show)
    result = ros2run(
        path_without_ros,
        'mine',
        'show',
        AMENT_PREFIX_PATH=str(tmp_path),
        _ROS_WHEELS_BOOTSTRAP_COMPLETE='1',
        LD_LIBRARY_PATH='/another/environment/lib',
        ROS_AUTOMATIC_DISCOVERY_RANGE='SUBNET',
    )
    marks, prefixes, discovery = result.stdout.splitlines()
    assert marks == 'unset unset'
    assert prefixes.split(':')[0] == str(tmp_path)
    assert any(prefix.endswith('ros2_ws/install/metagcttt') for prefix in prefixes.split(':'))
    assert discovery == 'SUBNET'


def test_discovery_stays_on_this_machine_by_default(
    path_without_ros: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv('ROS_AUTOMATIC_DISCOVERY_RANGE', raising=False)
    add_executable(tmp_path, 'mine', 'show', 'echo $ROS_AUTOMATIC_DISCOVERY_RANGE')
    result = ros2run(path_without_ros, 'mine', 'show', AMENT_PREFIX_PATH=str(tmp_path))
    assert result.stdout == 'LOCALHOST\n'


def test_real_command_is_handed_over_to(path_without_ros: Path) -> None:
    ros2 = path_without_ros / 'ros2'
    ros2.write_text('#!/bin/bash\necho "real $@"; exit 4\n')
    ros2.chmod(0o755)
    install = ROS2RUN.parents[1] / 'ros2_ws' / 'install'
    result = ros2run(
        path_without_ros,
        *('metagcttt', 'goal_node', '--ros-args', '-p', 'seed:=1'),
        AMENT_PREFIX_PATH=f'{install}/metagcttt',
    )
    assert (result.returncode, result.stdout) == (
        4,
        'real run metagcttt goal_node --ros-args -p seed:=1\n',
    )
