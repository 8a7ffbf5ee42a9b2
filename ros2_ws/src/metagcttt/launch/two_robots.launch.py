"""Start two robots in one graph, each in a namespace, a maze and a time of its own."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import (
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ROBOTS = ('robot1', 'robot2')
SHARED = ('stepping', 'environment', 'visualize', 'log_level')

ARGUMENTS = (
    DeclareLaunchArgument(
        'stepping',
        default_value='realtime',
        choices=['realtime', 'lockstep'],
        description='whether the worlds go on by themselves or wait for every action',
    ),
    DeclareLaunchArgument(
        'environment',
        default_value='pointmaze-medium-v0',
        description='name of both mazes, as sim_bridge knows it',
    ),
    *(
        DeclareLaunchArgument(
            f'{robot}_checkpoint',
            default_value='',
            description=f'folder of the policy of {robot}; empty: committed one',
        )
        for robot in ROBOTS
    ),
    DeclareLaunchArgument(
        'record', default_value='', description='file (.mcap) to record both to; empty: none'
    ),
    DeclareLaunchArgument(
        'visualize',
        default_value='false',
        choices=['true', 'false'],
        description='whether to publish odom, path and markers of both',
    ),
    DeclareLaunchArgument(
        'log_level',
        default_value='info',
        choices=['debug', 'info', 'warn', 'error', 'fatal'],
        description='log level of the nodes',
    ),
)


def robot_group(robot: str) -> GroupAction:
    """One robot; the group keeps its arguments from the other."""
    one_robot = PathJoinSubstitution(
        [FindPackageShare('metagcttt'), 'launch', 'metagcttt.launch.py']
    )
    arguments = {name: LaunchConfiguration(name) for name in SHARED}
    arguments['namespace'] = robot
    arguments['clock_topic'] = 'clock'
    arguments['checkpoint'] = LaunchConfiguration(f'{robot}_checkpoint')
    arguments['record'] = ''
    return GroupAction(
        [
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(one_robot), launch_arguments=arguments.items()
            )
        ]
    )


def generate_launch_description() -> LaunchDescription:
    """Two robots and, if asked for, one recorder for both."""
    record = LaunchConfiguration('record')
    return LaunchDescription(
        [
            *ARGUMENTS,
            *(robot_group(robot) for robot in ROBOTS),
            Node(
                package='metagcttt',
                executable='recorder_node',
                name='recorder_node',
                output='screen',
                parameters=[{'output': ParameterValue(record, value_type=str)}],
                condition=IfCondition(NotEqualsSubstitution(record, '')),
            ),
        ]
    )
