"""The registry of simulators, by name."""

from difflib import get_close_matches

from metagcttt_core.plugins import Registry

from sim_bridge.maze_map import MazeMap
from sim_bridge.simulator import Family, MazeDescription, Simulator

FAMILIES: Registry[Family] = Registry(
    'metagcttt.simulators',
    'family of simulators',
    {
        'ogbench': 'sim_bridge.mazes.ogbench:FAMILY',
        'robotics': 'sim_bridge.mazes.robotics:FAMILY',
    },
)


def environment_names() -> tuple[str, ...]:
    """Every name that `make_simulator` accepts."""
    return tuple(name for family in FAMILIES.values() for name in family.names())


def make_simulator(name: str, *, standing: bool = False) -> Simulator:
    """Build the simulator of a maze.

    Args:
        name: One of `environment_names()`, or the name of an OGBench dataset, which means the
            maze it was recorded in (`pointmaze-medium-navigate-v0` for `pointmaze-medium-v0`).
        standing: Start the tasks of a humanoid on its feet, not as OGBench does.

    Returns:
        A simulator without an episode; call `reset`.

    Raises:
        ValueError: If the name is unknown (names the nearest known one), or the robot has no other
            start than a standing one.
    """
    family, canonical = _find(name)
    simulator = family.make(canonical)
    if standing:
        simulator.start_standing()
    return simulator


def describe_environment(name: str) -> MazeDescription:
    """Spec, plan and tasks of a maze, without loading its physics.

    Raises:
        ValueError: If the name is unknown.
    """
    family, canonical = _find(name)
    return family.describe(canonical)


def maze_map(name: str) -> MazeMap:
    """Plan of a maze, without loading its physics; see `describe_environment`."""
    return describe_environment(name).maze


def _find(name: str) -> tuple[Family, str]:
    for family in FAMILIES.values():
        canonical = family.canonical_name(name)
        if canonical is not None:
            return family, canonical
    accepted = environment_names()
    nearest = get_close_matches(name, accepted, n=1, cutoff=0.0)[0]
    raise ValueError(
        f'unknown environment {name!r}, did you mean {nearest!r}? accepted: {", ".join(accepted)}'
    )
