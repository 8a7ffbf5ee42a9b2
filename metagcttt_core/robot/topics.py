"""Topics of a contract: what is read and written, with units, limits and deadlines."""

from collections import Counter
from collections.abc import Iterable
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from metagcttt_core.config import Settings

Reaction = Literal['zeros', 'hold', 'nothing']
"""What a command topic gets instead of the policy's command: zeros at once, the last command
again, or no message."""

TopicName = Annotated[str, Field(pattern=r'^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$')]
TypeName = Annotated[str, Field(pattern=r'^[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*$')]
FieldPath = Annotated[str, Field(pattern=r'^[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*$')]


def _as_tuple(value: Any) -> Any:
    return (value,) if isinstance(value, int | float) else value


PerValue = Annotated[
    tuple[float, ...],
    BeforeValidator(_as_tuple, json_schema_input_type=float | tuple[float, ...]),
    Field(min_length=1),
]
"""A number for all values of a field, or one for each."""


class Qos(Settings):
    """Quality of service of a topic."""

    reliability: Literal['reliable', 'best_effort'] = Field(
        'reliable', description='reliable: lost messages are sent again; best_effort: they are not'
    )
    durability: Literal['volatile', 'transient_local'] = Field(
        'volatile', description='transient_local: late joiners get the last messages too'
    )
    depth: int = Field(1, ge=1, le=10000, description='messages kept for a slow reader')


class Numbers(Settings):
    """The numbers in one field of a message."""

    field: FieldPath = Field(description='path of the field, such as pose.pose.position.x')
    joints: tuple[str, ...] = Field(
        (),
        description='names of joints, in the order of the values; the field is an array, ordered '
        "by the message's own `name` where it has one",
    )
    size: int | None = Field(
        None,
        ge=1,
        le=10000,
        description='length of a field that is an array without names of joints',
    )

    @model_validator(mode='after')
    def _check_shape(self) -> Self:
        if self.joints and self.size is not None:
            raise ValueError('give joints or size, not both')
        if repeated := repeated_names(self.joints):
            raise ValueError(f'joints names {", ".join(repeated)} more than once')
        return self

    @property
    def num_values(self) -> int:
        """How many numbers the field holds."""
        return len(self.joints) or self.size or 1


class ObservedValue(Numbers):
    """Numbers of a message that are part of the observation."""

    name: str = Field('', description='name in the observation; empty: the path of the field')
    transform: Literal['none', 'heading', 'angle', 'wrap'] = Field(
        'none',
        description='heading: cosine and sine of the yaw of a quaternion, two values; angle: '
        'those of an angle in radians; wrap: an angle brought to -pi to pi',
    )
    scale: float = Field(
        1.0,
        description='factor, applied after `origin` and before `transform`; 0.0174533 makes '
        'radians of degrees',
    )
    clamp: tuple[float, float] | None = Field(
        None, description='lowest and highest value; what lies beyond is observed as the bound'
    )
    origin: float = Field(
        0.0,
        description='subtracted before anything is rounded to single precision, which large '
        'coordinates such as UTM would not survive',
    )
    max_rate: float | None = Field(
        None,
        gt=0,
        description='fastest credible change per second; a message that jumps further is refused',
    )

    @model_validator(mode='after')
    def _check_transform(self) -> Self:
        if self.is_pair and (self.joints or self.size):
            raise ValueError(f'transform {self.transform} takes no joints and no size')
        if self.origin and (self.joints or self.transform == 'heading'):
            raise ValueError('headings and joints have no origin')
        if self.transform == 'heading' and self.scale != 1:
            raise ValueError('a heading has no scale')
        if not 1e-12 <= abs(self.scale) <= 1e12:
            raise ValueError('scale must be 1e-12 to 1e12, or the negative of that')
        if self.clamp and (self.clamp[0] >= self.clamp[1] or self.transform != 'none'):
            raise ValueError('clamp takes a lower and a higher bound, and no transform')
        return self

    @property
    def is_pair(self) -> bool:
        """True for an angle that is observed as its cosine and sine."""
        return self.transform in ('heading', 'angle')

    @property
    def columns(self) -> list[str]:
        """The names of the values in the observation."""
        name = self.name or self.field
        if self.is_pair:
            return [f'{name}.cos', f'{name}.sin']
        if self.joints:
            return [f'{joint}.{name}' for joint in self.joints]
        return [name] if self.size is None else [f'{name}.{i}' for i in range(self.size)]


class ObservedTopic(Settings):
    """A topic that is read."""

    topic: TopicName = Field(description="name; relative ones are in the robot's namespace")
    type: TypeName = Field(description='message type, such as nav_msgs/msg/Odometry')
    stamp: Literal['header', 'receive'] = Field(
        description='time of a message: that in its header, or that of its reception where the '
        "robot's clock is not this machine's"
    )
    frame_id: str | None = Field(
        None, description='frame that the header has to name; absent: any'
    )
    align: Literal['asof', 'hold', 'drop'] = Field(
        'asof',
        description='which message an observation takes: asof, the newest unless it is older than '
        'timeout_s; hold, the newest however old, for what is sent only when it changes; drop, '
        'the newest unless it is older than a control period',
    )
    timeout_s: float = Field(
        0.5, gt=0, le=3600, description='age from which the newest message is late, seconds'
    )
    qos: Qos = Field(
        Qos(reliability='best_effort', depth=10), description='quality of service to ask for'
    )
    values: tuple[ObservedValue, ...] = Field(min_length=1, description='what is read of it')


class CommandValue(Numbers):
    """Numbers of a message that a policy commands.

    Its actions -1 to 1 become `low` to `high`, or with `reach` the measured value less or plus
    that, within `low` to `high`.
    """

    low: PerValue = Field(description='lowest command, in units of the message; or one a value')
    high: PerValue = Field(description='highest command, in units of the message; or one a value')
    max_rate: PerValue | None = Field(
        None, description='fastest change of the command per second; or one a value'
    )
    measured: str = Field(
        '',
        description='observed field of the same joints from which the first command starts, such '
        'as position; empty: the first command starts from zero',
    )
    reach: PerValue | None = Field(
        None,
        description='farthest command from the measured value, in units of the message; or one a '
        'value. Actions are then distances from where the joints are, which targets of positions '
        'that lead a moving joint want; absent: actions are commands between low and high',
    )

    @model_validator(mode='after')
    def _check_limits(self) -> Self:
        for name in ('low', 'high', 'max_rate', 'reach'):
            given = getattr(self, name)
            if given is not None and len(given) not in (1, self.num_values):
                raise ValueError(f'{name} needs 1 or {self.num_values} numbers, got {len(given)}')
        if any(low >= high for low, high in zip(*self.limits, strict=True)):
            raise ValueError('low must be below high, value by value')
        if self.max_rate is not None and min(self.max_rate) <= 0:
            raise ValueError('max_rate must be positive')
        if self.measured and not self.joints:
            raise ValueError('measured takes joints')
        if self.reach is not None and not self.measured:
            raise ValueError('reach needs measured: the observed field that it counts from')
        if self.reach is not None and min(self.reach) <= 0:
            raise ValueError('reach must be positive')
        return self

    @property
    def limits(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lowest and highest commands, each value by value."""
        return self._each(self.low), self._each(self.high)

    @property
    def max_rates(self) -> tuple[float, ...]:
        """The fastest changes per second value by value, infinite where there is no limit."""
        return self._each(self.max_rate or (float('inf'),))

    @property
    def reaches(self) -> tuple[float, ...] | None:
        """The farthest commands from the measured values value by value, if actions are such."""
        return self._each(self.reach) if self.reach else None

    def _each(self, given: tuple[float, ...]) -> tuple[float, ...]:
        return given * self.num_values if len(given) == 1 else given


class Fallback(Settings):
    """What a command topic gets when there is no command of the policy."""

    fault: Reaction = Field(description='when observations are late or wrong, or others command')
    silent: Reaction = Field(description='when the policy is silent or keeps the robot still')
    no_goal: Reaction = Field(description='when there is no goal, or it is over')
    stop: Reaction = Field(description='while the robot is stopped by topic or service')
    shutdown: Reaction = Field(description='once, when the bridge ends')


def _same_for_all(value: Any) -> Any:
    return dict.fromkeys(Fallback.model_fields, value) if isinstance(value, str) else value


class CommandTopic(Settings):
    """A topic that is written."""

    topic: TopicName = Field(description="name; relative ones are in the robot's namespace")
    type: TypeName = Field(description='message type, such as geometry_msgs/msg/Twist')
    frame_id: str = Field('', description='frame that the header names, for types with a header')
    timeout_s: float = Field(
        0.5, gt=0, le=3600, description='age from which an observation is not acted on, seconds'
    )
    qos: Qos = Field(Qos(), description='quality of service to offer')
    values: tuple[CommandValue, ...] = Field(min_length=1, description='what is commanded in it')
    fallback: Annotated[
        Fallback, BeforeValidator(_same_for_all, json_schema_input_type=Fallback | Reaction)
    ] = Field(description='what is sent without a command of the policy; one word for every case')
    stops_within_rates: bool = Field(
        False, description='whether max_rate holds for zeros too; else a stop is sent at once'
    )
    zero_is_a_safe_position: bool = Field(
        False, description='says that zeros are meant although positions are commanded'
    )

    @model_validator(mode='after')
    def _check_zeros(self) -> Self:
        used = [case for case in Fallback.model_fields if getattr(self.fallback, case) == 'zeros']
        for value in self.values:
            low, high = value.limits
            if used and (max(low) > 0 or min(high) < 0):
                raise ValueError(
                    f'fallback {used[0]}: zeros is outside the limits of {value.field}; '
                    'use hold or nothing'
                )
            named = ' '.join((self.topic, value.field, value.measured)).lower()
            if used and 'position' in named and not self.zero_is_a_safe_position:
                raise ValueError(
                    f'fallback {used[0]}: zeros would drive the positions of {value.field} to '
                    'zero; use hold or nothing, or say zero_is_a_safe_position: true'
                )
        return self


def measured_columns(value: CommandValue) -> list[str]:
    """The observed values that commands of a field are measured against; empty: there are none."""
    return [f'{joint}.{value.measured}' for joint in value.joints] if value.measured else []


def repeated_names(names: Iterable[str]) -> list[str]:
    """Those that are there more than once."""
    return [name for name, count in Counter(names).items() if count > 1]
