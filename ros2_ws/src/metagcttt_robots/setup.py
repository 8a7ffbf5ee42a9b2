"""Build description of the ROS package; MuJoCo comes with the Python package's extra `mazes`."""

from setuptools import find_packages, setup

NAME = 'metagcttt_robots'

setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(include=[NAME]),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
    ],
    install_requires=['setuptools'],
    zip_safe=True,
    maintainer='metagcttt maintainers',
    maintainer_email='maintainers@metagcttt.org',
    description='Two simulated robots that speak standard messages only, and their drivers.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            f'{node} = {NAME}.main:{node}'
            for node in ('arm', 'arm_driver', 'diffbot', 'diffbot_driver')
        ]
    },
)
