"""The executables. What takes long to import waits until signals are handled."""

from collections.abc import Callable
import gc
from typing import Any, TYPE_CHECKING

from metagcttt.signals import stop_on_signals

if TYPE_CHECKING:
    from rclpy.node import Node


def goal_node() -> int:
    """Run the goal node until Ctrl-C or SIGTERM; returns the exit code."""

    def load() -> Callable[[], 'Node']:
        from metagcttt.goal.node import GoalNode

        return GoalNode

    return _main(load, farewell=lambda node: node.end_service())


def policy_node() -> int:
    """Run the policy node until Ctrl-C or SIGTERM; returns the exit code."""

    def load() -> Callable[[], 'Node']:
        from metagcttt.policy.node import PolicyNode

        return PolicyNode

    return _main(load)


def recorder_node() -> int:
    """Run the recorder until Ctrl-C or SIGTERM; returns the exit code."""

    def load() -> Callable[[], 'Node']:
        from metagcttt.recorder.node import RecorderNode

        return RecorderNode

    return _main(load)


def sim_bridge_node() -> int:
    """Run the simulator's bridge until Ctrl-C or SIGTERM; returns the exit code."""

    def load() -> Callable[[], 'Node']:
        from metagcttt.sim.node import SimBridgeNode

        return SimBridgeNode

    return _main(load)


def visualization_node() -> int:
    """Run the visualization node until Ctrl-C or SIGTERM; returns the exit code."""

    def load() -> Callable[[], 'Node']:
        from metagcttt.visualization.node import VisualizationNode

        return VisualizationNode

    return _main(load)


def _main(
    load: Callable[[], Callable[[], 'Node']], farewell: Callable[[Any], None] | None = None
) -> int:
    stop = stop_on_signals()
    try:
        make_node = load()
        from metagcttt.running import run

        return run(make_node, stop, farewell)
    except ImportError:
        # Compiled modules turn what a signal raises into this.
        if not stop.is_set():
            raise
        return 0
    finally:
        # At the exit, to look for garbage in all that PyTorch has imported takes up to seconds.
        gc.freeze()
