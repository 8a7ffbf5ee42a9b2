"""What the launch files have in common. Imports launch, which the nodes do without."""

from typing import Any

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('metagcttt')

_FLAG = ['true', 'false']
_ARGUMENTS: dict[str, dict[str, Any]] = {
    'namespace': {'default_value': '', 'description': 'namespace of the whole robot'},
    'stepping': {
        'default_value': 'realtime',
        'choices': ['realtime', 'lockstep'],
        'description': 'whether the world goes on by itself or waits for every action; '
        'chooses the parameter file',
    },
    'params_file': {
        'default_value': [
            PathJoinSubstitution([SHARE, 'config', LaunchConfiguration('stepping')]),
            '.yaml',
        ],
        'description': 'parameter file of the three nodes, instead of the one for `stepping`',
    },
    'environment': {
        'default_value': 'pointmaze-medium-v0',
        'description': 'name of the maze, as sim_bridge knows it',
    },
    'checkpoint': {
        'default_value': '',
        'description': 'folder of the policy; empty: committed one',
    },
    'dataset': {'default_value': '', 'description': 'dataset file (.npz); empty: committed one'},
    'autostart': {
        'default_value': 'true',
        'choices': _FLAG,
        'description': 'whether the policy node configures and activates itself',
    },
    'use_sim_time': {
        'default_value': 'true',
        'choices': _FLAG,
        'description': "whether the goal and policy nodes follow the simulator's clock",
    },
    'clock_topic': {
        'default_value': '/clock',
        'description': 'topic of the simulated time; relative for one in the namespace, so that '
        'several robots have times of their own',
    },
    'policy': {
        'default_value': 'true',
        'choices': _FLAG,
        'description': 'whether to start the policy node; false where something else does',
    },
    'record': {'default_value': '', 'description': 'file (.mcap) to record to; empty: none'},
    'visualize': {
        'default_value': 'false',
        'choices': _FLAG,
        'description': 'whether to publish odom, path and markers; RViz shows them',
    },
    'rviz': {
        'default_value': 'false',
        'choices': _FLAG,
        'description': 'whether to start RViz, which has to be installed',
    },
    'log_level': {
        'default_value': 'info',
        'choices': ['debug', 'info', 'warn', 'error', 'fatal'],
        'description': 'log level of the nodes',
    },
}


def declare(*names: str) -> list[DeclareLaunchArgument]:
    """Declarations of arguments by their names; all there are when none is named."""
    return [DeclareLaunchArgument(name, **_ARGUMENTS[name]) for name in names or _ARGUMENTS]


def text(argument: str) -> ParameterValue:
    """A launch argument as a string parameter; a bare substitution is read as YAML."""
    return ParameterValue(LaunchConfiguration(argument), value_type=str)


def flag(argument: str) -> ParameterValue:
    """A launch argument as a boolean parameter."""
    return ParameterValue(LaunchConfiguration(argument), value_type=bool)
