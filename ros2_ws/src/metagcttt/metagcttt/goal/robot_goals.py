"""Goals of a robot with a contract: poses, named values and whole observations."""

from collections import Counter
from collections.abc import Sequence
from itertools import chain
import math

from metagcttt_core import TrajectoryDataset
from metagcttt_core.robot import Contract, identity_fault, MessageError
from metagcttt_core.robot.contract import GoalSection
from metagcttt_core.robot.numbers import heading, transformed
from metagcttt_core.robot.topics import ObservedValue
import numpy as np
from numpy.typing import NDArray

from metagcttt.goal.goals import Resolved
from metagcttt.goal.obstacles import Obstacles
from metagcttt.goal.target import Term
from metagcttt.goal.tracker import GoalRequest
from metagcttt.goal.verdict import Verdict
from metagcttt.input_checks import vector_fault


class _Refused(Exception):
    def __init__(self, *verdict: str) -> None:
        self.verdict = Verdict(*verdict)  # type: ignore[arg-type] # one of the names


class RobotGoals:
    """Checks goals against a contract, the data and the map, and completes them.

    Attributes:
        obstacles: Of the newest map; None before the first.
    """

    def __init__(self, contract: Contract, dataset: TrajectoryDataset) -> None:
        """Create the catalog of a robot's goals.

        Raises:
            ValueError: If the contract has no section `goal`, or the dataset is of another one.
        """
        if contract.goal is None:
            raise ValueError(f'the contract of {contract.robot} has no section goal')
        what = f'the dataset {dataset.source or ""}'
        if fault := identity_fault(what, dataset.contract, contract.identity):
            raise ValueError(fault)
        if dataset.obs_dim != contract.obs_dim:
            raise ValueError(
                f'{what} has observations of {dataset.obs_dim} values, the contract of '
                f'{contract.robot} of {contract.obs_dim}'
            )
        self.obstacles: Obstacles | None = None
        self._contract = contract
        self._section: GoalSection = contract.goal
        self._dataset = dataset
        observations = dataset.observations
        low, high = (
            extreme.astype(np.float64) + dataset.origin
            for extreme in (observations.min(axis=0), observations.max(axis=0))
        )
        margin = self._section.beyond_data * (high - low)
        rounding = 1e-6 * np.maximum(np.abs(low), np.abs(high))
        self._low, self._high = low - margin - rounding, high + margin + rounding
        spread = high - low
        self._spread = np.where(spread > 0, spread, 1.0)
        self._values: dict[str, ObservedValue] = {
            column: value
            for value in chain.from_iterable(topic.values for topic in contract.observe)
            for column in value.columns
        }

    @property
    def frame_id(self) -> str:
        """Frame of goal poses and of states."""
        return self._section.frame_id or self._contract.frame_id

    def resolve(self, request: GoalRequest) -> Resolved | Verdict:
        """The goal that a request asks for, or why there is none."""
        try:
            if request.observation is not None:
                return self._whole(request.observation)
            if request.names:
                return self._named(request.names, request.values, request.tolerances)
            return self._pose(request)
        except _Refused as refused:
            return refused.verdict

    def _whole(self, observation: NDArray[np.float64]) -> Resolved:
        if fault := vector_fault('the goal', observation, self._contract.obs_dim):
            is_short = observation.shape != (self._contract.obs_dim,)
            raise _Refused('WRONG_SIZE' if is_short else 'NOT_FINITE', fault)
        terms = [
            term
            for name, tolerance in self._section.tolerance.items()
            for term in self._terms(name, tolerance)
        ]
        return self._checked(observation, dict(enumerate(observation)), terms)

    def _named(
        self, names: Sequence[str], values: Sequence[float], tolerances: Sequence[float]
    ) -> Resolved:
        if len(names) != len(values) or len(tolerances) not in (0, len(names)):
            raise _Refused(
                'WRONG_SIZE',
                f'{len(names)} names, {len(values)} values and {len(tolerances)} tolerances do '
                'not fit together',
            )
        if twice := next((name for name, count in Counter(names).items() if count > 1), ''):
            raise _Refused('UNKNOWN_VALUE', f'{twice} is named twice, each value may be once')
        fixed: dict[int, float] = {}
        terms: list[Term] = []
        for number, (name, value) in enumerate(zip(names, values, strict=True)):
            tolerance = tolerances[number] if tolerances else self._tolerance(name)
            if not (math.isfinite(value) and math.isfinite(tolerance) and tolerance > 0):
                raise _Refused('NOT_FINITE', f'{name}: {value} within {tolerance} is no goal')
            columns, is_pair = self._contract.groups.get(name, ([], False))
            if is_pair and len(columns) == 2:
                new = dict(zip(columns, (math.cos(value), math.sin(value)), strict=True))
            else:
                new = {self._column(name): value}
            if fixed.keys() & new.keys():
                raise _Refused('UNKNOWN_VALUE', f'{name} is named twice, by another name too')
            fixed |= new
            terms += self._terms(name, tolerance)
        return self._completed(fixed, terms)

    def _pose(self, request: GoalRequest) -> Resolved:
        contract = self._contract
        if contract.position is None:
            raise _Refused(
                'UNKNOWN_VALUE',
                f'{contract.robot} has no position: send a goal by named values, of '
                f'{", ".join(contract.columns)}',
            )
        if request.frame_id != self.frame_id:
            raise _Refused(
                'WRONG_FRAME',
                f'the goal is in frame {request.frame_id!r}, goals are in {self.frame_id!r}',
            )
        if not all(map(math.isfinite, request.xy)):
            raise _Refused('NOT_FINITE', f'the position {request.xy} is not finite')
        fixed = {
            contract.columns.index(name): float(
                transformed(self._values[name], np.array([number]))[0]
            )
            for name, number in zip(contract.position, request.xy, strict=True)
        }
        tolerance = self._section.tolerance
        names = ('distance',) if 'distance' in tolerance else contract.position
        terms = [term for name in names for term in self._terms(name, self._tolerance(name))]
        if yaw := self._section.yaw:
            try:
                fixed |= zip(contract.groups[yaw][0], heading(*request.quaternion), strict=True)
            except MessageError as error:
                raise _Refused('NOT_FINITE', f'the orientation of the goal: {error}') from error
            terms += self._terms(yaw, tolerance[yaw])
        return self._completed(fixed, terms)

    def _column(self, name: str) -> int:
        columns, is_pair = self._contract.groups.get(name, ([], False))
        if name in self._contract.columns:
            return self._contract.columns.index(name)
        if len(columns) == 1 and not is_pair:
            return columns[0]
        raise _Refused(
            'UNKNOWN_VALUE',
            f'no observed value is named {name!r} (there are: '
            f'{", ".join(self._contract.columns)})',
        )

    def _tolerance(self, name: str) -> float:
        """The contract's tolerance of a value, of its group, or of the position."""
        given = self._section.tolerance
        if name in given:
            return given[name]
        column = self._column(name)
        for group, (columns, _) in self._contract.groups.items():
            if group in given and column in columns:
                return given[group]
        if name in (self._contract.position or ()) and 'distance' in given:
            return given['distance']
        raise _Refused('UNKNOWN_VALUE', f'the contract has no tolerance of {name}, give one')

    def _terms(self, name: str, tolerance: float) -> list[Term]:
        """What a tolerance by name asks for."""
        contract = self._contract
        if name == 'distance' and contract.position:
            dims = tuple(contract.columns.index(each) for each in contract.position)
            return [Term(name, 'distance', dims, tolerance)]
        columns, is_pair = contract.groups.get(name, ([], False))
        if is_pair:
            return [Term(name, 'angle', tuple(columns), tolerance)]
        if name in contract.columns:
            columns = [contract.columns.index(name)]
        terms = []
        for column in columns:
            each = contract.columns[column]
            is_turn = self._values[each].transform == 'wrap'
            terms.append(Term(each, 'turn' if is_turn else 'value', (column,), tolerance))
        return terms

    def _completed(self, fixed: dict[int, float], terms: list[Term]) -> Resolved:
        """The goal observation: the fixed values, and the rest of the nearest state of the data.

        Each value counts in a distance by the range of the data.
        """
        dims = list(fixed)
        wanted = np.array([fixed[dim] for dim in dims]) - self._dataset.origin[dims]
        offsets = (self._dataset.observations[:, dims] - wanted) / self._spread[dims]
        row = int(np.square(offsets).sum(axis=1).argmin())
        observation = np.array(self._dataset.states(row), dtype=np.float64)
        observation[dims] = list(fixed.values())
        return self._checked(observation, fixed, terms)

    def _checked(
        self, observation: NDArray[np.float64], fixed: dict[int, float], terms: list[Term]
    ) -> Resolved:
        contract = self._contract
        for column, value in fixed.items():
            name = contract.columns[column]
            if self._values[name].is_pair:
                continue
            if not self._low[column] <= value <= self._high[column]:
                raise _Refused(
                    'OUTSIDE_DATA',
                    f'{name} {value:.4g} is outside the data, which span '
                    f'{self._low[column]:.4g} to {self._high[column]:.4g}',
                )
        xy = (math.nan, math.nan)
        if contract.position:
            dims = [contract.columns.index(name) for name in contract.position]
            xy = (float(observation[dims[0]]), float(observation[dims[1]]))
            if self._section.map and set(dims) <= set(fixed):
                self._check_map(xy)
        return Resolved(observation, xy, tuple(terms), self._section.timeout_s)

    def _check_map(self, xy: tuple[float, float]) -> None:
        if self.obstacles is None:
            topic = self._section.map.topic if self._section.map else ''
            raise _Refused('NO_MAP', f'no usable map has arrived on {topic} yet')
        if self.obstacles.frame_id != self.frame_id:
            raise _Refused(
                'WRONG_FRAME',
                f'the map is in frame {self.obstacles.frame_id!r}, goals are in {self.frame_id!r}',
            )
        # Observed positions are counted from the contract's origins, the map is not.
        x, y = (
            number / self._values[name].scale + self._values[name].origin
            for name, number in zip(self._contract.position or (), xy, strict=True)
        )
        if refusal := self.obstacles.refusal(x, y):
            raise _Refused(refusal.error, refusal.reason)
