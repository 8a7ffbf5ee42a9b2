"""Start one robot: the simulator, the goal node and the policy; also recorder, pictures, RViz."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = (
    DeclareLaunchArgument(
        'namespace', default_value='', description='namespace of the whole robot'
    ),
    DeclareLaunchArgument(
        'stepping',
        default_value='realtime',
        choices=['realtime', 'lockstep'],
        description='whether the world goes on by itself or waits for every action; '
        'chooses the parameter file',
    ),
    DeclareLaunchArgument(
        'params_file',
        default_value=[
            PathJoinSubstitution(
                [FindPackageShare('metagcttt'), 'config', LaunchConfiguration('stepping')]
            ),
            '.yaml',
        ],
        description='parameter file of the three nodes, instead of the one for `stepping`',
    ),
    DeclareLaunchArgument(
        'environment',
        default_value='pointmaze-medium-v0',
        description='name of the maze, as sim_bridge knows it',
    ),
    DeclareLaunchArgument(
        'checkpoint', default_value='', description='folder of the policy; empty: committed one'
    ),
    DeclareLaunchArgument(
        'dataset', default_value='', description='dataset file (.npz); empty: committed one'
    ),
    DeclareLaunchArgument(
        'autostart',
        default_value='true',
        choices=['true', 'false'],
        description='whether the policy node configures and activates itself',
    ),
    DeclareLaunchArgument(
        'use_sim_time',
        default_value='true',
        choices=['true', 'false'],
        description="whether the goal and policy nodes follow the simulator's clock",
    ),
    DeclareLaunchArgument(
        'clock_topic',
        default_value='/clock',
        description='topic of the simulated time; relative for one in the namespace, so that '
        'several robots have times of their own',
    ),
    DeclareLaunchArgument(
        'policy',
        default_value='true',
        choices=['true', 'false'],
        description='whether to start the policy node; false where something else does',
    ),
    DeclareLaunchArgument(
        'record', default_value='', description='file (.mcap) to record to; empty: none'
    ),
    DeclareLaunchArgument(
        'visualize',
        default_value='false',
        choices=['true', 'false'],
        description='whether to publish odom, path and markers; RViz shows them',
    ),
    DeclareLaunchArgument(
        'rviz',
        default_value='false',
        choices=['true', 'false'],
        description='whether to start RViz, which has to be installed',
    ),
    DeclareLaunchArgument(
        'log_level',
        default_value='info',
        choices=['debug', 'info', 'warn', 'error', 'fatal'],
        description='log level of the nodes',
    ),
)

SHOWN = ('map', 'odom', 'path', 'markers', 'goal_pose')


def text(argument: str) -> ParameterValue:
    """A launch argument as a string parameter; a bare substitution is read as YAML."""
    return ParameterValue(LaunchConfiguration(argument), value_type=str)


def flag(argument: str) -> ParameterValue:
    """A launch argument as a boolean parameter."""
    return ParameterValue(LaunchConfiguration(argument), value_type=bool)


def generate_launch_description() -> LaunchDescription:
    """The nodes; everything they can be told is in `ARGUMENTS` or the parameter file."""
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
            *ARGUMENTS,
            # One machine, unless the user says otherwise.
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
                    PathJoinSubstitution(
                        [FindPackageShare('metagcttt'), 'rviz', 'metagcttt.rviz']
                    ),
                ],
                # The file names the topics of a robot without a namespace.
                remappings=[(f'/{topic}', topic) for topic in SHOWN],
                condition=IfCondition(LaunchConfiguration('rviz')),
            ),
        ]
    )
