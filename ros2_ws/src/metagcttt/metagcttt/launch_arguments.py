"""Arguments of the launch files and what they share. Imports launch, which nodes do not need."""

from pathlib import Path
import sys
import time
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.logging import get_logger
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('metagcttt')
OF_LAUNCH = {
    'emulate_tty',
    'launch-prefix',
    'launch-prefix-filter',
    'sigkill_timeout',
    'sigterm_timeout',
}
"""Arguments that launch itself understands."""

RESPAWN_DELAY_S = 1.0
RESPAWN_WINDOW_S = 60.0

_FLAG = ['true', 'false']
_ELSE = "empty: the parameter file's or, without one there, the node's own default"
_ARGUMENTS: dict[str, dict[str, Any]] = {
    'namespace': {'default_value': '', 'description': 'namespace of the whole robot'},
    'stepping': {
        'default_value': 'realtime',
        'choices': ['realtime', 'lockstep'],
        'description': 'whether the simulator steps on its own or waits for every action; '
        'selects the parameter file, so that it is not given together with one',
    },
    'params_file': {
        'default_value': [
            PathJoinSubstitution([SHARE, 'config', LaunchConfiguration('stepping')]),
            '.yaml',
        ],
        'description': 'parameter file of the three nodes, instead of the one for `stepping`',
    },
    'environment': {
        'default_value': '',
        'description': f'name of the maze in sim_bridge; {_ELSE}',
    },
    'checkpoint': {
        'default_value': '',
        'description': f'folder of the policy; {_ELSE}',
    },
    'dataset': {
        'default_value': '',
        'description': f'dataset file (.npz); {_ELSE}',
    },
    'autostart': {
        'default_value': '',
        'choices': ['', *_FLAG],
        'description': f'whether the policy node configures and activates itself; {_ELSE}',
    },
    'adapter': {
        'default_value': '',
        'description': f'service of an adapter_node that adapts for the policy node; {_ELSE}',
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
    'respawn_limit': {
        'default_value': '3',
        'description': 'times within a minute that a node that ends is started again; the next '
        'time, or with 0 the first, everything is shut down',
    },
    'log_level': {
        'default_value': 'info',
        'choices': ['debug', 'info', 'warn', 'error', 'fatal'],
        'description': 'log level of the nodes',
    },
}


ALL = tuple(_ARGUMENTS)


def declare(file: str, *names: str, **others: str) -> list[Any]:
    """Declarations of arguments, and their check when the file is the one that is launched.

    Args:
        file: The launch file, whose `__file__` it is.
        names: Names of arguments from the table above.
        others: Descriptions of other arguments by name, which are empty by default.
    """
    table = {name: _ARGUMENTS[name] for name in names}
    table |= {name: {'default_value': '', 'description': text} for name, text in others.items()}
    check = OpaqueFunction(function=lambda context: refuse(context, Path(file).name, set(table)))
    return [check, *(DeclareLaunchArgument(name, **kwargs) for name, kwargs in table.items())]


def refuse(context: LaunchContext, file: str, known: set[str]) -> None:
    """Refuse arguments that would be ignored; launch accepts any.

    Args:
        context: The context, which has the words of the command line.
        file: Name of a launch file; nothing is checked where another one includes it.
        known: The arguments that it declares.

    Raises:
        ValueError: If one is unknown, or two contradict one another.
    """
    if file not in {Path(word).name for word in sys.argv}:
        return
    given = {word.partition(':=')[0] for word in context.argv}
    if unknown := sorted(given - known - OF_LAUNCH):
        raise ValueError(
            f'{file} has no argument {", ".join(unknown)}; it has {", ".join(sorted(known))}'
        )
    if {'stepping', 'params_file'} <= given:
        raise ValueError('stepping selects a parameter file, params_file is one: give one of them')


def given(context: LaunchContext, *names: str) -> dict[str, Any]:
    """Those of the arguments that are not empty, as parameters of a node."""
    values = {name: context.launch_configurations[name] for name in names}
    return {
        # A bare string would be read as YAML.
        name: value == 'true' if value in _FLAG else ParameterValue(value, value_type=str)
        for name, value in values.items()
        if value
    }


def common(context: LaunchContext) -> dict[str, Any]:
    """What every node of a robot is started with.

    Raises:
        ValueError: If `respawn_limit` is no number from 0.
    """
    return {
        'package': 'metagcttt',
        'namespace': context.launch_configurations['namespace'],
        'output': 'screen',
        'remappings': [('/clock', context.launch_configurations['clock_topic'])],
        'arguments': ['--ros-args', '--log-level', context.launch_configurations['log_level']],
        **respawning(context),
    }


def respawning(context: LaunchContext) -> dict[str, Any]:
    """How a node is started again, by the argument `respawn_limit`.

    Raises:
        ValueError: If it is no number from 0.
    """
    text = context.launch_configurations['respawn_limit']
    if not text.isdecimal():
        raise ValueError(f'respawn_limit must be 0 or a positive number, got {text!r}')
    return {
        'respawn': True,
        'respawn_delay': RESPAWN_DELAY_S,
        'on_exit': Respawns(int(text)).on_exit,
    }


class Respawns:
    """Says that a node has ended and, where it ends too often, shuts everything down."""

    def __init__(self, limit: int) -> None:
        """Allow `limit` ends of a node within `RESPAWN_WINDOW_S`."""
        self._limit = limit
        self._ends: dict[str, list[float]] = {}

    def on_exit(self, event: ProcessExited, context: LaunchContext) -> list[Shutdown]:
        """Handle the end of a node, which launch starts again unless it is shutting down."""
        if context.is_shutdown:
            return []
        now_s = time.monotonic()
        recent = [
            s for s in self._ends.get(event.process_name, ()) if now_s - s < RESPAWN_WINDOW_S
        ]
        self._ends[event.process_name] = [*recent, now_s]
        what = f'{event.process_name} ended with exit code {event.returncode}'
        logger = get_logger('metagcttt')
        if len(recent) < self._limit:
            logger.warning(f'{what} and is started again, {len(recent) + 1} of {self._limit}')
            return []
        logger.error(f'{what}: shutting down all nodes')
        return [Shutdown(reason=what)]
