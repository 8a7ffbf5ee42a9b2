"""Entry points of the executables. Slow imports wait until signals are handled."""

from collections.abc import Callable
from functools import wraps
import os
import sys
import threading
from typing import NoReturn

from metagcttt.signals import stop_on_signals


def _executable(main: Callable[[threading.Event], int]) -> Callable[[], NoReturn]:
    """An entry point that hands `main` the event set by Ctrl-C and SIGTERM, and ends with it."""

    @wraps(main)
    def run_main() -> NoReturn:
        stop = stop_on_signals()
        try:
            status = main(stop)
        except ImportError:
            # Compiled modules turn the exception that a signal raises into this.
            if not stop.is_set():
                raise
            status = 0
        _leave(status)

    return run_main


def _leave(status: int) -> NoReturn:
    """End the process without the interpreter's teardown; what ends in order has ended.

    Over all that PyTorch imported that takes a third of a second of a processor, seconds on a
    busy machine, which `ros2 launch` waits for no longer than five.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


@_executable
def adapter_node(stop: threading.Event) -> int:
    """Run the adapter of many robots until Ctrl-C or SIGTERM; returns the exit code."""
    from metagcttt.adapter.node import AdapterNode
    from metagcttt.running import run

    return run(AdapterNode, stop, farewell=AdapterNode.end_service)


@_executable
def goal_node(stop: threading.Event) -> int:
    """Run the goal node until Ctrl-C or SIGTERM; returns the exit code."""
    from metagcttt.goal.node import GoalNode
    from metagcttt.running import run

    return run(GoalNode, stop, farewell=GoalNode.end_service)


@_executable
def policy_node(stop: threading.Event) -> int:
    """Run the policy node until Ctrl-C or SIGTERM; returns the exit code."""
    from metagcttt.policy.node import PolicyNode
    from metagcttt.running import run

    return run(PolicyNode, stop)


@_executable
def recorder_node(stop: threading.Event) -> int:
    """Run the recorder node until Ctrl-C or SIGTERM; returns the exit code."""
    from metagcttt.recorder.node import RecorderNode
    from metagcttt.running import run

    return run(RecorderNode, stop)


@_executable
def robot_bridge_node(stop: threading.Event) -> int:
    """Run the bridge to a robot until Ctrl-C or SIGTERM; returns the exit code."""
    from metagcttt.robot.node import RobotBridgeNode
    from metagcttt.running import run

    return run(RobotBridgeNode, stop, farewell=RobotBridgeNode.end_service)


@_executable
def sim_bridge_node(stop: threading.Event) -> int:
    """Run the simulator bridge until Ctrl-C or SIGTERM; returns the exit code."""
    from metagcttt.running import run
    from metagcttt.sim.node import SimBridgeNode

    return run(SimBridgeNode, stop)


@_executable
def visualization_node(stop: threading.Event) -> int:
    """Run the visualization node until Ctrl-C or SIGTERM; returns the exit code."""
    from metagcttt.running import run
    from metagcttt.visualization.node import VisualizationNode

    return run(VisualizationNode, stop)
