"""Start one robot whose policy node is configured and activated by launch.

If the policy cannot be configured, or ends, everything is shut down.
"""

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import (
    EmitEvent,
    IncludeLaunchDescription,
    OpaqueFunction,
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
from metagcttt.launch_arguments import ALL, common, declare, given, Respawns, SHARE

ARGUMENTS = tuple(name for name in ALL if name not in ('autostart', 'policy'))


def policy(context: LaunchContext) -> list[Action]:
    """The policy node and the handlers of its lifecycle, which come before what they handle."""
    shared = common(context)
    del shared['respawn'], shared['respawn_delay']
    node = LifecycleNode(
        executable='policy_node',
        name='policy_node',
        parameters=[
            LaunchConfiguration('params_file'),
            {'autostart': False},
            given(context, 'checkpoint', 'dataset', 'adapter', 'use_sim_time'),
        ],
        **shared | {'on_exit': Respawns(0).on_exit},
    )

    def request(transition_id: int) -> EmitEvent:
        return EmitEvent(
            event=ChangeState(
                lifecycle_node_matcher=matches_action(node), transition_id=transition_id
            )
        )

    return [
        RegisterEventHandler(
            OnStateTransition(
                target_lifecycle_node=node,
                start_state='configuring',
                goal_state='inactive',
                entities=[request(Transition.TRANSITION_ACTIVATE)],
            )
        ),
        RegisterEventHandler(
            OnStateTransition(
                target_lifecycle_node=node,
                start_state='configuring',
                goal_state='unconfigured',
                entities=[Shutdown(reason='the policy cannot be configured, see its log')],
            )
        ),
        node,
        request(Transition.TRANSITION_CONFIGURE),
    ]


def generate_launch_description() -> LaunchDescription:
    """The robot without its policy, then the policy."""
    rest = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution([SHARE, 'launch', 'metagcttt.launch.py'])
        ),
        launch_arguments={
            **{name: LaunchConfiguration(name) for name in ARGUMENTS},
            'policy': 'false',
        }.items(),
    )
    return LaunchDescription(
        [*declare(__file__, *ARGUMENTS), rest, OpaqueFunction(function=policy)]
    )
