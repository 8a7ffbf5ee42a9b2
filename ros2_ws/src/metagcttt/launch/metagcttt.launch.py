"""Start one robot: simulator, goal node and policy; optionally recorder and visualization."""

from launch import LaunchDescription
from launch.actions import SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import LifecycleNode, Node
from metagcttt.launch_arguments import declare, flag, SHARE, text

SHOWN = ('map', 'odom', 'path', 'markers', 'goal_pose')


def generate_launch_description() -> LaunchDescription:
    """The nodes of one robot; other settings are in the parameter file."""
    namespace = LaunchConfiguration('namespace')
    common = {
        'package': 'metagcttt',
        'namespace': namespace,
        'output': 'screen',
        'remappings': [('/clock', LaunchConfiguration('clock_topic'))],
        'arguments': ['--ros-args', '--log-level', LaunchConfiguration('log_level')],
    }
    params_file = LaunchConfiguration('params_file')
    environment = {'environment': text('environment')}
    dataset = {'dataset': text('dataset')}
    clock = {'use_sim_time': flag('use_sim_time')}
    policy = {'checkpoint': text('checkpoint'), 'autostart': flag('autostart')}
    return LaunchDescription(
        [
            *declare(),
            # Only this machine, unless the user sets it.
            SetEnvironmentVariable(
                'ROS_AUTOMATIC_DISCOVERY_RANGE',
                EnvironmentVariable('ROS_AUTOMATIC_DISCOVERY_RANGE', default_value='LOCALHOST'),
            ),
            Node(
                executable='sim_bridge_node',
                name='sim_bridge_node',
                parameters=[params_file, environment],
                **common,
            ),
            Node(
                executable='goal_node',
                name='goal_node',
                parameters=[params_file, environment, dataset, clock],
                **common,
            ),
            LifecycleNode(
                executable='policy_node',
                name='policy_node',
                parameters=[params_file, dataset, policy, clock],
                condition=IfCondition(LaunchConfiguration('policy')),
                **common,
            ),
            Node(
                executable='visualization_node',
                name='visualization_node',
                parameters=[environment, dataset, {'checkpoint': text('checkpoint')}],
                condition=IfCondition(LaunchConfiguration('visualize')),
                **common,
            ),
            Node(
                executable='recorder_node',
                name='recorder_node',
                parameters=[{'output': text('record')}],
                condition=IfCondition(NotEqualsSubstitution(LaunchConfiguration('record'), '')),
                **common,
            ),
            Node(
                package='rviz2',
                executable='rviz2',
                name='rviz2',
                namespace=namespace,
                arguments=[
                    '-d',
                    PathJoinSubstitution([SHARE, 'rviz', 'metagcttt.rviz']),
                ],
                # The file names the topics of a robot without a namespace.
                remappings=[(f'/{topic}', topic) for topic in SHOWN],
                condition=IfCondition(LaunchConfiguration('rviz')),
            ),
        ]
    )
