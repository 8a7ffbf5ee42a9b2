"""Arguments of the launch files. Imports launch, which the nodes do not need."""

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
        'description': 'whether the simulator steps on its own or waits for every action; '
        'selects the parameter file',
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
        'description': 'name of the maze in sim_bridge',
    },
    'checkpoint': {
        'default_value': '',
        'description': 'folder of the policy; empty: the committed one',
    },
    'dataset': {
        'default_value': '',
        'description': 'dataset file (.npz); empty: the committed one',
    },
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
        'description': 'topic of the simulated time; a relative name is in the namespace, so that '
        'each robot has its own time',
    },
    'policy': {
        'default_value': 'true',
        'choices': _FLAG,
        'description': 'whether to start the policy node; false when something else starts it',
    },
    'record': {'default_value': '', 'description': 'file (.mcap) to record to; empty: none'},
    'visualize': {
        'default_value': 'false',
        'choices': _FLAG,
        'description': 'whether to publish odom, path and markers for RViz',
    },
    'rviz': {
        'default_value': 'false',
        'choices': _FLAG,
        'description': 'whether to start RViz, which must be installed',
    },
    'log_level': {
        'default_value': 'info',
        'choices': ['debug', 'info', 'warn', 'error', 'fatal'],
        'description': 'log level of the nodes',
    },
}


def declare(*names: str) -> list[DeclareLaunchArgument]:
    """Declarations of the named arguments, or of all."""
    return [DeclareLaunchArgument(name, **_ARGUMENTS[name]) for name in names or _ARGUMENTS]


def text(argument: str) -> ParameterValue:
    """A launch argument as a string parameter; a bare substitution would be read as YAML."""
    return ParameterValue(LaunchConfiguration(argument), value_type=str)


def flag(argument: str) -> ParameterValue:
    """A launch argument as a boolean parameter."""
    return ParameterValue(LaunchConfiguration(argument), value_type=bool)
