"""Base class of all typed settings."""

from difflib import get_close_matches
from typing import Any

from pydantic import BaseModel, ConfigDict, model_validator, ValidationError
from pydantic_core import ErrorDetails


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
                    close = get_close_matches(str(key), cls.model_fields, n=1)
                    hint = f'; did you mean {close[0]!r}?' if close else ''
                    known = ', '.join(cls.model_fields)
                    raise UnknownSettingError(
                        f'{cls.__name__} has no setting {key!r}{hint} (known: {known})', str(key)
                    )
        return values


def error_lines(error: ValidationError) -> list[str]:
    """One readable line per problem: the field, what was got and what is accepted."""
    return [error_line(problem) for problem in error.errors()]


def error_line(problem: ErrorDetails) -> str:
    """One problem of a `pydantic.ValidationError` as a readable line."""
    field = '.'.join(str(part) for part in problem['loc'])
    message = problem['msg'].removeprefix('Value error, ')
    got = '' if isinstance(problem['input'], dict | BaseModel) else f', got {problem["input"]!r}'
    return f'{field}: {message}{got}' if field else f'{message}{got}'
