"""The column map: which columns of a table are observed and commanded, and where it is cut."""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from metagcttt_core.config import Settings
from metagcttt_core.config.yaml_file import load_yaml
from metagcttt_core.robot import Contract
from pydantic import BeforeValidator, Field, model_validator

from metagcttt_tools.common.names import commanded_names


def _one_column(value: Any) -> Any:
    return {'column': value} if isinstance(value, str) else value


class ObservedColumn(Settings):
    """A column of the observation."""

    column: str = Field(min_length=1, description='its name')
    values: tuple[int | str, ...] = Field(
        (), description='of a column of lists: which values, by number from 0 or by name; all'
    )
    origin: float = Field(
        0.0,
        description='subtracted before anything is rounded to single precision, which large '
        'coordinates such as UTM would not survive',
    )


class CommandColumn(Settings):
    """A column of the action.

    With limits, `low` to `high` become -1 to 1; with `reach`, the observed value `measured` less
    and plus that.
    """

    column: str = Field(min_length=1, description='its name')
    values: tuple[int | str, ...] = Field(
        (), description='of a column of lists: which values, by number from 0 or by name; all'
    )
    low: float | None = Field(None, description='lowest command, in units of the table')
    high: float | None = Field(None, description='highest command, in units of the table')
    measured: str = Field(
        '', description='name of the observed value that the command leads, such as a joint'
    )
    reach: float | None = Field(
        None, gt=0, description='farthest command from the measured value, in units of the table'
    )

    @model_validator(mode='after')
    def _check_limits(self) -> Self:
        if (self.reach is None) == bool(self.measured):
            raise ValueError('give measured and reach, or neither')
        if (self.low is None) != (self.high is None):
            raise ValueError('give low and high, or neither')
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError('low must be below high')
        return self


class Cut(Settings):
    """Where trajectories end; every rule that is given holds."""

    episode: str | None = Field(None, description='column that numbers or names the trajectories')
    last: str | None = Field(None, description='column that is true or 1 in last rows')
    gap_s: float | None = Field(
        None, gt=0, description='cut between rows further apart in time, seconds'
    )
    file: bool = Field(False, description='a file is a trajectory')

    @model_validator(mode='after')
    def _must_say_where(self) -> Self:
        if not (self.episode or self.last or self.gap_s or self.file):
            raise ValueError(
                'say where trajectories are cut, by one or more of: episode (a column that '
                'changes), last (a column that is true in last rows), gap_s (seconds), file (true)'
            )
        return self

    def in_words(self) -> str:
        """The rules as text."""
        rules = [
            f'{self.episode} changes' if self.episode else '',
            f'{self.last} is true' if self.last else '',
            f'rows are more than {self.gap_s:g} s apart' if self.gap_s else '',
            'a file ends',
        ]
        return ', '.join(rule for rule in rules if rule)


Observed = Annotated[
    ObservedColumn,
    BeforeValidator(_one_column, json_schema_input_type=ObservedColumn | str),
]
Commanded = Annotated[
    CommandColumn, BeforeValidator(_one_column, json_schema_input_type=CommandColumn | str)
]


class ColumnMap(Settings):
    """What the columns of a table are."""

    observations: tuple[Observed, ...] = Field(min_length=1, description='in their order')
    actions: tuple[Commanded, ...] = Field(min_length=1, description='in their order')
    position: tuple[str, ...] = Field(
        (), description='the observed values, by name, that the filter measures distances by'
    )
    time: str | None = Field(None, description='column of times, ascending in a trajectory')
    time_unit: Literal['s', 'ms', 'us', 'ns'] = Field('s', description='of the times')
    cut: Cut | None = Field(None, description='where trajectories end')
    delimiter: str = Field(',', min_length=1, max_length=1, description='between values of a CSV')

    @property
    def columns(self) -> list[str]:
        """The names of the observed and commanded columns."""
        return [each.column for each in self.observations] + [each.column for each in self.actions]

    @model_validator(mode='after')
    def _gaps_take_times(self) -> Self:
        if self.cut is not None and self.cut.gap_s is not None and self.time is None:
            raise ValueError('cut by gap_s takes a column of times: give time')
        return self


def load_columns(path: Path) -> ColumnMap:
    """The column map in a YAML file.

    Raises:
        SettingsFileError: With a line for each mistake: file, line, setting and what is accepted.
    """
    return load_yaml(path, ColumnMap)


def map_of_contract(
    contract: Contract, *, observed_in: str = '', commanded_in: str = ''
) -> ColumnMap:
    """The column map of a table whose values have the names of a contract.

    Args:
        contract: The contract; its limits are those of the actions.
        observed_in: Column of lists that holds the observed values; else each is a column.
        commanded_in: The same for the commands.
    """
    how = [
        {'low': each['low'], 'high': each['high']}
        | ({'measured': each['from'], 'reach': each['reach']} if 'reach' in each else {})
        for each in contract.meaning['actions']
    ]
    return ColumnMap(
        observations=tuple(
            ObservedColumn(**_place(name, observed_in)) for name in contract.columns
        ),
        actions=tuple(
            CommandColumn(**_place(name, commanded_in), **limits)
            for name, limits in zip(commanded_names(contract), how, strict=True)
        ),
        position=tuple(contract.columns[dim] for dim in contract.position_dims),
    )


def _place(name: str, column: str) -> dict[str, Any]:
    return {'column': column, 'values': (name,)} if column else {'column': name}
