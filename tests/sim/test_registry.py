"""Simulators by name."""

import subprocess
import sys

import pytest
from sim_bridge import describe_environment, environment_names, make_simulator, maze_map

DIVERSE = ('_Diverse_G', '_Diverse_GR')


def test_every_maze_that_the_package_can_build_is_there() -> None:
    ogbench = {
        f'{robot}maze-{size}-v0'
        for robot in ('point', 'ant', 'humanoid')
        for size in ('medium', 'large', 'giant', 'teleport')
        if (robot, size) != ('humanoid', 'teleport')
    }
    robotics = {
        f'{robot}_{size}-{version}'
        for robot, versions in (('PointMaze', ['v3']), ('AntMaze', ['v3', 'v4', 'v5']))
        for version in versions
        for size in (
            'UMaze',
            *(f'{s}{d}' for s in ('Open', 'Medium', 'Large') for d in ('', *DIVERSE)),
        )
    }
    assert set(environment_names()) == ogbench | robotics


@pytest.mark.parametrize('kind', ['navigate', 'stitch', 'explore'])
def test_dataset_name_stands_for_its_maze(kind: str) -> None:
    description = describe_environment(f'antmaze-large-{kind}-v0')
    assert description.spec.name == 'antmaze-large-v0'
    assert maze_map(f'antmaze-large-{kind}-v0') is description.maze


@pytest.mark.parametrize(
    ('name', 'nearest'),
    [
        ('pointmaze-mediun-v0', 'pointmaze-medium-v0'),
        ('antmaze-large', 'antmaze-large-v0'),
        ('PointMaze_medium-v3', 'PointMaze_Medium-v3'),
        ('pointmaze-medium-play-v0', 'pointmaze-medium-v0'),
        ('', 'pointmaze'),
    ],
)
def test_unknown_name_is_refused_with_the_nearest_and_all_accepted(
    name: str, nearest: str
) -> None:
    with pytest.raises(
        ValueError, match=f"unknown environment '{name}', did you mean '{nearest}.*accepted: point"
    ):
        make_simulator(name)
    with pytest.raises(ValueError, match='unknown environment'):
        maze_map(name)


def test_description_loads_neither_physics_nor_learning() -> None:
    code = (
        'import sys, sim_bridge\n'
        "assert sim_bridge.maze_map('antmaze-giant-v0').walls.shape == (12, 16)\n"
        "print([m for m in ('mujoco', 'gymnasium', 'torch', 'rclpy') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == '[]'
