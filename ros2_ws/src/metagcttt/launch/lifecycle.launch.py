"""Start one robot whose policy node is configured and activated by launch.

If the policy cannot be configured, everything is shut down.
"""

from launch import LaunchDescription
from launch.actions import (
    EmitEvent,
    IncludeLaunchDescription,
    RegisterEventHandler,
    Shutdown,
)
from launch.events.matchers import matches_action
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition
from metagcttt.launch_arguments import declare, SHARE, text

ARGUMENTS = ('namespace', 'stepping', 'params_file', 'checkpoint', 'dataset')


def generate_launch_description() -> LaunchDescription:
    """The robot without its policy, the policy node and the handlers of its lifecycle."""
    policy = LifecycleNode(
        package='metagcttt',
        executable='policy_node',
        name='policy_node',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[
            LaunchConfiguration('params_file'),
            {
                'autostart': False,
                'use_sim_time': True,
                'checkpoint': text('checkpoint'),
                'dataset': text('dataset'),
            },
        ],
    )

    def request(transition_id: int) -> EmitEvent:
        return EmitEvent(
            event=ChangeState(
                lifecycle_node_matcher=matches_action(policy), transition_id=transition_id
            )
        )

    return LaunchDescription(
        [
            *declare(*ARGUMENTS),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(
                    PathJoinSubstitution([SHARE, 'launch', 'metagcttt.launch.py'])
                ),
                launch_arguments={
                    'namespace': LaunchConfiguration('namespace'),
                    'stepping': LaunchConfiguration('stepping'),
                    'params_file': LaunchConfiguration('params_file'),
                    'dataset': LaunchConfiguration('dataset'),
                    'policy': 'false',
                }.items(),
            ),
            # The handlers come before the events they handle.
            RegisterEventHandler(
                OnStateTransition(
                    target_lifecycle_node=policy,
                    start_state='configuring',
                    goal_state='inactive',
                    entities=[request(Transition.TRANSITION_ACTIVATE)],
                )
            ),
            RegisterEventHandler(
                OnStateTransition(
                    target_lifecycle_node=policy,
                    start_state='configuring',
                    goal_state='unconfigured',
                    entities=[Shutdown(reason='the policy cannot be configured, see its log')],
                )
            ),
            policy,
            request(Transition.TRANSITION_CONFIGURE),
        ]
    )
