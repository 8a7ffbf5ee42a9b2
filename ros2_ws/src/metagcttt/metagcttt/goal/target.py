"""What a goal fixes of a robot's observation, and how far the robot is from it."""

from dataclasses import dataclass
import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Term:
    """One thing that has to be so at the goal.

    Attributes:
        name: Its name in the contract.
        kind: distance: straight, between points; angle: of a cosine and a sine; turn: of an angle
            in radians; value: of any number.
        columns: The observed values that it is about.
        tolerance: Largest deviation.
    """

    name: str
    kind: Literal['distance', 'angle', 'turn', 'value']
    columns: tuple[int, ...]
    tolerance: float

    def deviation(self, observation: NDArray[np.float64], goal: NDArray[np.float64]) -> float:
        """How far an observation is from a goal observation in this respect."""
        here, there = observation[list(self.columns)], goal[list(self.columns)]
        if self.kind == 'distance':
            return math.dist(here, there)
        if self.kind == 'value':
            return abs(float(here[0] - there[0]))
        angles = (float(each[0]) for each in (here, there))
        if self.kind == 'angle':
            angles = (math.atan2(each[1], each[0]) for each in (here, there))
        one, other = angles
        return abs(math.remainder(one - other, 2 * math.pi))


def miss(
    terms: tuple[Term, ...], observation: NDArray[np.float64], goal: NDArray[np.float64]
) -> str:
    """What is still too far from the goal, in words; empty when it is reached."""
    found = [(term, term.deviation(observation, goal)) for term in terms]
    return ', '.join(
        f'{term.name} is off by {deviation:.3g} ({term.tolerance:g} is allowed)'
        for term, deviation in found
        if not deviation <= term.tolerance
    )
