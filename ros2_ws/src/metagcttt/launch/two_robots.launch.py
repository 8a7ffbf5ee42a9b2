"""Start two robots in one graph, each with its own namespace, maze and simulated time."""

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import (
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from metagcttt.launch_arguments import declare, given, respawning, SHARE

ROBOTS = ('robot1', 'robot2')
SHARED = (
    *('stepping', 'params_file', 'environment', 'dataset', 'autostart', 'adapter'),
    *('use_sim_time', 'visualize', 'respawn_limit', 'log_level'),
)

CHECKPOINTS = {
    f'{robot}_checkpoint': f"folder of the policy of {robot}; empty: the parameter file's"
    for robot in ROBOTS
}


def robot_group(robot: str) -> GroupAction:
    """One robot, in a group that scopes its arguments."""
    one_robot = PathJoinSubstitution([SHARE, 'launch', 'metagcttt.launch.py'])
    arguments = {name: LaunchConfiguration(name) for name in SHARED}
    arguments['namespace'] = robot
    arguments['clock_topic'] = 'clock'
    arguments['checkpoint'] = LaunchConfiguration(f'{robot}_checkpoint')
    arguments |= {'record': '', 'policy': 'true', 'rviz': 'false'}
    return GroupAction(
        [
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(one_robot), launch_arguments=arguments.items()
            )
        ]
    )


def recorder(context: LaunchContext) -> list[Node]:
    """The recorder of both robots."""
    return [
        Node(
            package='metagcttt',
            executable='recorder_node',
            name='recorder_node',
            output='screen',
            parameters=[{'output': given(context, 'record').get('record', '')}],
            arguments=['--ros-args', '--log-level', LaunchConfiguration('log_level')],
            condition=IfCondition(NotEqualsSubstitution(LaunchConfiguration('record'), '')),
            **respawning(context),
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Two robots and, with `record`, one recorder for both."""
    return LaunchDescription(
        [
            *declare(__file__, *SHARED, 'record', **CHECKPOINTS),
            *(robot_group(robot) for robot in ROBOTS),
            OpaqueFunction(function=recorder),
        ]
    )
