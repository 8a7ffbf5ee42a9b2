"""The executables. What is slow to import waits until signals are handled."""

from metagcttt.running import run, stop_on_signals


def goal_node() -> int:
    """Run the goal node until Ctrl-C or SIGTERM; returns the exit code."""
    stop = stop_on_signals()
    from metagcttt.goal_node import GoalNode

    return run(GoalNode, stop, farewell=GoalNode.end_service)


def policy_node() -> int:
    """Run the policy node until Ctrl-C or SIGTERM; returns the exit code."""
    stop = stop_on_signals()
    from metagcttt.policy_node import PolicyNode

    return run(PolicyNode, stop)


def recorder_node() -> int:
    """Run the recorder until Ctrl-C or SIGTERM; returns the exit code."""
    stop = stop_on_signals()
    from metagcttt.recorder_node import RecorderNode

    return run(RecorderNode, stop)


def sim_bridge_node() -> int:
    """Run the simulator's bridge until Ctrl-C or SIGTERM; returns the exit code."""
    stop = stop_on_signals()
    from metagcttt.sim_bridge_node import SimBridgeNode

    return run(SimBridgeNode, stop)


def visualization_node() -> int:
    """Run the node that makes what RViz shows until Ctrl-C or SIGTERM; returns the exit code."""
    stop = stop_on_signals()
    from metagcttt.visualization_node import VisualizationNode

    return run(VisualizationNode, stop)
