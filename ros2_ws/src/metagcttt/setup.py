"""Build description of the ROS package; the Python packages it needs are in pyproject.toml."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'metagcttt'

setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch', glob('launch/*.launch.py')),
        (f'share/{NAME}/config', glob('config/*.yaml')),
        (f'share/{NAME}/rviz', glob('rviz/*.rviz')),
    ],
    install_requires=['setuptools'],
    zip_safe=True,
    maintainer='metagcttt maintainers',
    maintainer_email='maintainers@metagcttt.org',
    description='A goal-conditioned policy that adapts to every goal it is given.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            f'{node} = {NAME}.main:{node}'
            for node in (
                'adapter_node',
                'goal_node',
                'policy_node',
                'recorder_node',
                'robot_bridge_node',
                'sim_bridge_node',
                'visualization_node',
            )
        ]
    },
)
