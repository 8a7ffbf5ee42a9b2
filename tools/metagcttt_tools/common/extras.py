"""What is not part of the smallest installation, and what brings it."""

import sys

EXTRAS = {
    'PIL': 'mazes',
    'gymnasium': 'mazes',
    'gymnasium_robotics': 'mazes',
    'h5py': 'minari',
    'matplotlib': 'plots',
    'mcap': 'recordings',
    'mcap_ros2': 'recordings',
    'mujoco': 'mazes',
    'ogbench': 'mazes',
    'pyarrow': 'tables',
    'ray': 'cluster',
    'rosbags': 'recordings',
    'scipy': 'plots',
    'tensorboard': 'plots',
    'viser': 'view',
}
"""The extra that brings a package, by the name under which it is imported."""


def install_command(package: str) -> str:
    """The command that installs one of the `EXTRAS`."""
    if package == 'ogbench' and sys.version_info >= (3, 13):
        return 'pip install --no-deps ogbench'  # see pyproject.toml
    return f'pip install "metagcttt-core[{EXTRAS[package]}]"'
