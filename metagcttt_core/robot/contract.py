"""The contract between a policy and a robot: its topics, goals and retrieval."""

from functools import cached_property
import hashlib
from itertools import chain
import json
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from metagcttt_core.config import Settings
from metagcttt_core.robot.topics import (
    CommandTopic,
    measured_columns,
    ObservedTopic,
    repeated_names,
    TopicName,
)


class GoalMap(Settings):
    """A map with obstacles, in which no goal can be."""

    topic: TopicName = Field('map', description='topic of the nav_msgs/msg/OccupancyGrid')
    occupied_above: int = Field(
        50, ge=0, le=100, description='occupancy from which a cell is an obstacle, percent'
    )
    unknown_is_free: bool = Field(False, description='whether goals may be in unknown cells')
    clearance_m: float = Field(
        0.0, ge=0, le=100, description='distance to keep from obstacles, metres'
    )


class GoalSection(Settings):
    """What a goal may fix, and when it is reached."""

    tolerance: dict[str, Annotated[float, Field(gt=0)]] = Field(
        min_length=1,
        description='largest deviation at the goal by name: an observed value, or one with an '
        'angle (radians); `distance`: straight from `position`, metres',
    )
    timeout_s: float = Field(
        60.0, gt=0, le=86400, description='time that a goal may take, seconds'
    )
    yaw: str = Field(
        '', description='observed heading that the orientation of a goal pose fixes; empty: none'
    )
    frame_id: str = Field(
        '', description='frame of goal poses; empty: that of the first topic that names one'
    )
    beyond_data: float = Field(
        0.0,
        ge=0,
        description='how far outside the range of the data a goal may lie, as a share of it',
    )
    map: GoalMap | None = Field(None, description='obstacles in which goals are refused')


class Retrieval(Settings):
    """How near a trajectory has to pass the robot to be adapted on."""

    values: tuple[str, ...] = Field(
        (), description='observed values that distances use; empty: `position`'
    )
    epsilon: float = Field(gt=0, description='largest distance, in units of these values')


class Contract(Settings):
    """All that a policy and a robot have to agree on.

    Observations and actions are the values of all topics in the order of this contract.
    """

    robot: str = Field(min_length=1, description='name of the robot')
    rate_hz: float = Field(gt=0, le=1000, description='rate of observations and actions, hertz')
    observe: tuple[ObservedTopic, ...] = Field(min_length=1, description='topics that are read')
    act: tuple[CommandTopic, ...] = Field(min_length=1, description='topics that are written')
    position: tuple[str, str] | None = Field(
        None, description='names of the observed values that are x and y of the robot, metres'
    )
    goal: GoalSection | None = Field(None, description='goals of the robot; absent: it takes none')
    retrieval: Retrieval | None = Field(
        None, description='distances between states; absent: the settings of the programs'
    )

    @model_validator(mode='after')
    def _check_whole(self) -> Self:
        for name, topics in (
            ('observe', [topic.topic for topic in self.observe]),
            ('act', [topic.topic for topic in self.act]),
        ):
            if repeated := repeated_names(topics):
                raise ValueError(f'{name} has {", ".join(repeated)} more than once')
        if repeated := repeated_names(self.columns):
            raise ValueError(
                f'several observed values are named {", ".join(repeated)}: give them a name'
            )
        measured = [
            name
            for topic in self.act
            for value in topic.values
            for name in measured_columns(value)
        ]
        retrieved = self.retrieval.values if self.retrieval else ()
        wanted = [*(self.position or ()), *retrieved, *measured]
        if unknown := [name for name in wanted if name not in self.columns]:
            raise ValueError(
                f'no observed value is named {unknown[0]} (there are: {", ".join(self.columns)})'
            )
        for value in (value for topic in self.observe for value in topic.values):
            if (value.scale, value.clamp, value.transform) == (1.0, None, 'none'):
                continue
            if changed := set(value.columns).intersection(measured):
                raise ValueError(
                    f'{min(changed)} is measured for commands: it takes no scale, clamp or '
                    'transform'
                )
        for topic in self.act:
            if topic.timeout_s < 1.0 / self.rate_hz:
                raise ValueError(
                    f'timeout_s of {topic.topic} is {topic.timeout_s:g} s, shorter than a period '
                    f'at rate_hz {self.rate_hz:g}, {1 / self.rate_hz:g} s'
                )
        self._check_goal()
        return self

    def _check_goal(self) -> None:
        if self.retrieval and not (self.retrieval.values or self.position):
            raise ValueError('retrieval needs values, or the contract a position')
        if self.goal is None:
            return
        names = {*self.columns, *self.groups, *(('distance',) if self.position else ())}
        if unknown := [name for name in self.goal.tolerance if name not in names]:
            raise ValueError(
                f'goal: no value {unknown[0]} to tolerate (there are: {", ".join(sorted(names))})'
            )
        if self.goal.yaw and self.groups.get(self.goal.yaw, ('', False))[1] is False:
            pairs = [name for name, (_, is_pair) in self.groups.items() if is_pair]
            raise ValueError(
                f'goal: yaw {self.goal.yaw} is no observed heading (there are: '
                f'{", ".join(pairs) or "none"})'
            )
        if self.goal.yaw and self.goal.yaw not in self.goal.tolerance:
            raise ValueError(f'goal: yaw needs a tolerance of {self.goal.yaw}')
        if self.goal.map and not self.position:
            raise ValueError('goal: a map takes a contract with a position')

    @cached_property
    def groups(self) -> dict[str, tuple[list[int], bool]]:
        """Columns of each observed value by its name, and whether they are cosine and sine."""
        found: dict[str, tuple[list[int], bool]] = {}
        for value in chain.from_iterable(topic.values for topic in self.observe):
            columns, _ = found.get(value.name or value.field, ([], False))
            columns += [self.columns.index(name) for name in value.columns]
            found[value.name or value.field] = (columns, value.is_pair)
        return found

    @cached_property
    def meaning(self) -> dict[str, Any]:
        """What the numbers of observations and actions stand for; plain data for a file.

        Topics, deadlines and reactions are left out: they may change under the same policy.
        """
        observed = [
            {name: getattr(value, name) for name in ('transform', 'scale', 'clamp', 'origin')}
            for topic in self.observe
            for value in topic.values
            for _ in value.columns
        ]
        commanded = [
            {'name': f'{joint}.{value.field}' if joint else value.field, 'low': low, 'high': high}
            | ({'reach': reach, 'from': f'{joint}.{value.measured}'} if reach else {})
            for topic in self.act
            for value in topic.values
            for joint, low, high, reach in zip(
                value.joints or [''] * value.num_values,
                *value.limits,
                value.reaches or [None] * value.num_values,
                strict=True,
            )
        ]
        meaning = {
            'rate_hz': self.rate_hz,
            'observations': [
                {'name': name, **how} for name, how in zip(self.columns, observed, strict=True)
            ],
            'actions': commanded,
        }
        return json.loads(json.dumps(meaning))  # as a file gives it back

    @property
    def identity(self) -> dict[str, Any]:
        """What datasets and checkpoints keep of a contract; compared by `identity_fault`."""
        text = json.dumps(self.meaning, sort_keys=True)
        digest = hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
        return {
            'robot': self.robot,
            'fingerprint': digest,
            'position_dims': list(self.position_dims),
            'epsilon': self.retrieval.epsilon if self.retrieval else None,
            **self.meaning,
        }

    @property
    def position_dims(self) -> tuple[int, ...]:
        """The columns of the values that distances between states use; empty: none are named."""
        names = (self.retrieval.values if self.retrieval else ()) or self.position or ()
        return tuple(self.columns.index(name) for name in names)

    @cached_property
    def columns(self) -> list[str]:
        """The names of the values of an observation."""
        values = chain.from_iterable(topic.values for topic in self.observe)
        return list(chain.from_iterable(value.columns for value in values))

    @property
    def topics(self) -> list[ObservedTopic | CommandTopic]:
        """All topics, those that are read first."""
        return [*self.observe, *self.act]

    @property
    def frame_id(self) -> str:
        """Frame of the observations: that of the first topic that names one; empty: none does."""
        return next((topic.frame_id for topic in self.observe if topic.frame_id), '')

    @property
    def obs_dim(self) -> int:
        """Length of an observation."""
        return len(self.columns)

    @property
    def act_dim(self) -> int:
        """Length of an action."""
        return sum(value.num_values for topic in self.act for value in topic.values)

    @property
    def period_ns(self) -> int:
        """Time between two observations, nanoseconds."""
        return round(1e9 / self.rate_hz)
