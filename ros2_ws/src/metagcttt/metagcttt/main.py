"""The executables. What takes long to import waits until signals are handled."""

from collections.abc import Callable
import gc
from importlib import import_module
from typing import Any

from metagcttt.signals import stop_on_signals


def goal_node() -> int:
    """Run the goal node until Ctrl-C or SIGTERM; returns the exit code."""
    return _main('GoalNode', 'goal_node', farewell=lambda node: node.end_service())


def policy_node() -> int:
    """Run the policy node until Ctrl-C or SIGTERM; returns the exit code."""
    return _main('PolicyNode', 'policy_node')


def recorder_node() -> int:
    """Run the recorder until Ctrl-C or SIGTERM; returns the exit code."""
    return _main('RecorderNode', 'recorder_node')


def sim_bridge_node() -> int:
    """Run the simulator's bridge until Ctrl-C or SIGTERM; returns the exit code."""
    return _main('SimBridgeNode', 'sim_bridge_node')


def visualization_node() -> int:
    """Run the node that makes what RViz shows until Ctrl-C or SIGTERM; returns the exit code."""
    return _main('VisualizationNode', 'visualization_node')


def _main(node: str, module: str, farewell: Callable[[Any], None] | None = None) -> int:
    stop = stop_on_signals()
    try:
        node_type = getattr(import_module(f'metagcttt.{module}'), node)
        run = import_module('metagcttt.running').run
        return run(node_type, stop, farewell)
    except ImportError:
        # Compiled modules turn what a signal raises into this.
        if not stop.is_set():
            raise
        return 0
    finally:
        # At the exit, to look for garbage in all that PyTorch has imported takes up to seconds.
        gc.freeze()
