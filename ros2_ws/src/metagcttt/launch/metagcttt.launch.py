"""Start one robot: simulator, goal node and policy; optionally recorder and visualization."""

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import LifecycleNode, Node
from metagcttt.launch_arguments import ALL, common, declare, given, SHARE

SHOWN = ('map', 'odom', 'path', 'markers', 'goal_pose')


def nodes(context: LaunchContext) -> list[Node]:
    """The nodes of one robot; other settings are in the parameter file."""
    shared = common(context)
    params_file = LaunchConfiguration('params_file')
    clock = given(context, 'use_sim_time')
    environment = given(context, 'environment')
    return [
        Node(
            executable='sim_bridge_node',
            name='sim_bridge_node',
            parameters=[params_file, environment],
            **shared,
        ),
        Node(
            executable='goal_node',
            name='goal_node',
            parameters=[params_file, given(context, 'environment', 'dataset'), clock],
            **shared,
        ),
        LifecycleNode(
            executable='policy_node',
            name='policy_node',
            parameters=[
                params_file,
                given(context, 'dataset', 'checkpoint', 'autostart', 'adapter'),
                clock,
            ],
            condition=IfCondition(LaunchConfiguration('policy')),
            **shared,
        ),
        Node(
            executable='visualization_node',
            name='visualization_node',
            parameters=[params_file, given(context, 'environment', 'dataset', 'checkpoint')],
            condition=IfCondition(LaunchConfiguration('visualize')),
            **shared,
        ),
        Node(
            executable='recorder_node',
            name='recorder_node',
            parameters=[params_file, {'output': given(context, 'record').get('record', '')}],
            condition=IfCondition(NotEqualsSubstitution(LaunchConfiguration('record'), '')),
            **shared,
        ),
        Node(
            package='rviz2',
            executable='rviz2',
            name='rviz2',
            namespace=LaunchConfiguration('namespace'),
            arguments=[
                '-d',
                PathJoinSubstitution([SHARE, 'rviz', 'metagcttt.rviz']),
            ],
            # The file names the topics of a robot without a namespace.
            remappings=[(f'/{topic}', topic) for topic in SHOWN],
            condition=IfCondition(LaunchConfiguration('rviz')),
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """The arguments and the nodes of one robot."""
    return LaunchDescription(
        [
            *declare(__file__, *ALL),
            # Only this machine, unless the user sets it.
            SetEnvironmentVariable(
                'ROS_AUTOMATIC_DISCOVERY_RANGE',
                EnvironmentVariable('ROS_AUTOMATIC_DISCOVERY_RANGE', default_value='LOCALHOST'),
            ),
            OpaqueFunction(function=nodes),
        ]
    )
