"""What the view has to know of a robot: which values of an observation place and turn it."""

from dataclasses import dataclass
from pathlib import Path

from metagcttt_core.robot import load_contract
import numpy as np
from sim_bridge import describe_environment, environment_names, MazeMap


@dataclass(frozen=True)
class Robot:
    """A robot, by its simulator or its contract.

    Attributes:
        environment: Name of its simulator; empty for a robot with a contract.
        position_dims: Where x and y are in an observation, in metres; empty: nowhere.
        heading_dims: Where cosine and sine of its yaw are; empty: nowhere.
        tolerance_m: Distance within which a goal is reached, metres.
    """

    environment: str = ''
    position_dims: tuple[int, ...] = ()
    heading_dims: tuple[int, ...] = ()
    tolerance_m: float = 1.0


def simulated(environment: str, tolerance_m: float = 0.0) -> Robot:
    """The robot of a simulator; tolerance 0 stands for the simulator's own."""
    spec = describe_environment(environment).spec
    return Robot(environment, spec.position_dims, tolerance_m=tolerance_m or spec.goal_tolerance_m)


def contracted(path: Path) -> Robot:
    """The robot of a contract.

    Raises:
        ContractError: If the contract cannot be read or is wrong.
    """
    contract = load_contract(path)
    columns = contract.columns
    headings = [
        value.columns
        for topic in contract.observe
        for value in topic.values
        if value.transform == 'heading'
    ]
    return Robot(
        position_dims=tuple(columns.index(name) for name in contract.position or ()),
        heading_dims=tuple(columns.index(name) for name in (headings or [[]])[0]),
    )


def recorded(maze: MazeMap, obs_dim: int) -> Robot | None:
    """The robot of a recording, which does not name it: the first with such a maze, or None."""
    for name in environment_names():
        found = describe_environment(name)
        if found.spec.obs_dim == obs_dim and (
            np.array_equal(found.maze.walls, maze.walls)
            and np.allclose(found.maze.extent, maze.extent)
        ):
            return simulated(name)
    return None
