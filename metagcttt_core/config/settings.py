"""Base class of all typed settings."""

from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    field_validator,
    model_validator,
    ValidationError,
    ValidationInfo,
)
from pydantic_core import ErrorDetails

_LONGEST = 200
"""Characters of a wrong value that a message shows."""


class UnknownSettingError(ValueError):
    """A key that is no setting; `key` is the one."""

    def __init__(self, message: str, key: str) -> None:
        """Keep the key."""
        super().__init__(message)
        self.key = key


class Settings(BaseModel):
    """Frozen, validated settings; an unknown key is refused with the nearest known one.

    Subclasses declare fields with a description (unit included) and a range. A wrong value raises
    `pydantic.ValidationError`, a `ValueError` that names the field, the value and what is allowed.
    """

    model_config = ConfigDict(frozen=True, extra='forbid', allow_inf_nan=False)

    @model_validator(mode='before')
    @classmethod
    def _refuse_unknown_keys(cls, values: Any) -> Any:
        if isinstance(values, dict):
            for key in values:
                if key not in cls.model_fields:
                    near = nearest_name(str(key), _dotted_names(cls))
                    hint = f'; did you mean {near!r}?' if near else ''
                    known = ', '.join(cls.model_fields)
                    raise UnknownSettingError(
                        f'{cls.__name__} has no setting {key!r}{hint} (known: {known})', str(key)
                    )
        return values

    @field_validator('*', mode='before')
    @classmethod
    def _refuse_truth_as_number(cls, value: Any, info: ValidationInfo) -> Any:
        """YAML reads yes and on as true, which pydantic would take for 1."""
        if _holds_truth(value):
            kinds = set(_kinds(cls.model_fields[info.field_name or ''].annotation))
            if kinds & {int, float} and bool not in kinds:
                raise ValueError('must be a number, not true or false')
        return value


def _kinds(annotation: Any) -> Iterator[Any]:
    """The types within an annotation, those of containers and unions too."""
    yield annotation
    for inner in get_args(annotation):
        yield from _kinds(inner)


def _holds_truth(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(map(_holds_truth, value.values()))
    if isinstance(value, list | tuple):
        return any(map(_holds_truth, value))
    return isinstance(value, bool)


def nearest_name(wrong: str, names: Iterable[str]) -> str:
    """The name that was probably meant, of dotted ones by their last part; '' if none is near."""
    by_last_part: dict[str, str] = {}
    for name in names:
        by_last_part.setdefault(name.rpartition('.')[2], name)
    close = get_close_matches(wrong.rpartition('.')[2], by_last_part, n=1)
    return by_last_part[close[0]] if close else ''


def _dotted_names(model: type[BaseModel]) -> Iterator[str]:
    """All settings, those of the model before those within them."""
    yield from model.model_fields
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from (f'{name}.{inner}' for inner in _dotted_names(field.annotation))


def error_lines(error: ValidationError) -> list[str]:
    """One readable line per problem: the field, what was got and what is accepted."""
    return [error_line(problem) for problem in error.errors()]


def error_line(problem: ErrorDetails) -> str:
    """One problem of a `pydantic.ValidationError` as a readable line."""
    field = '.'.join(str(part) for part in problem['loc'])
    message = problem['msg'].removeprefix('Value error, ')
    given = problem['input']
    got = '' if isinstance(given, dict | BaseModel) else f', got {_in_short(given)}'
    return f'{field}: {message}{got}' if field else f'{message}{got}'


def _in_short(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # which Python does not write out
        return 'a number of thousands of digits'
    return text if len(text) <= _LONGEST else f'{text[:_LONGEST]}...'
