"""Simulators of robots in mazes behind one small interface."""

from sim_bridge.maze_map import MazeMap
from sim_bridge.registry import (
    describe_environment,
    environment_names,
    make_simulator,
    maze_map,
)
from sim_bridge.simulator import (
    MazeDescription,
    Simulator,
    SimulatorError,
    SimulatorSpec,
    StepResult,
    Task,
)

__all__ = [
    'MazeDescription',
    'MazeMap',
    'Simulator',
    'SimulatorError',
    'SimulatorSpec',
    'StepResult',
    'Task',
    'describe_environment',
    'environment_names',
    'make_simulator',
    'maze_map',
]
