"""Start two robots in one graph, each with its own namespace, maze and simulated time."""

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
from metagcttt.launch_arguments import declare, SHARE, text

ROBOTS = ('robot1', 'robot2')
SHARED = ('stepping', 'environment', 'visualize', 'log_level')

CHECKPOINTS = [
    DeclareLaunchArgument(
        f'{robot}_checkpoint',
        default_value='',
        description=f'folder of the policy of {robot}; empty: the committed one',
    )
    for robot in ROBOTS
]


def robot_group(robot: str) -> GroupAction:
    """One robot, in a group that scopes its arguments."""
    one_robot = PathJoinSubstitution([SHARE, 'launch', 'metagcttt.launch.py'])
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
    """Two robots and, with `record`, one recorder for both."""
    record = LaunchConfiguration('record')
    return LaunchDescription(
        [
            *declare(*SHARED, 'record'),
            *CHECKPOINTS,
            *(robot_group(robot) for robot in ROBOTS),
            Node(
                package='metagcttt',
                executable='recorder_node',
                name='recorder_node',
                output='screen',
                parameters=[{'output': text('record')}],
                condition=IfCondition(NotEqualsSubstitution(record, '')),
            ),
        ]
    )
